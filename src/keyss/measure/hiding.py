"""How well a hiding works, on the test views of its scenes: the numbers of `metrics.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from keyss.core.alignment import align
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import ImageQuality, mean_psnr, quality, subsample_views
from keyss.keys import random_embeddings
from keyss.methods.base import Opened
from keyss.rendering import render

WRONG_KEYS = 32
_FIDELITY_VIEWS = 8


@dataclass(frozen=True)
class BaselineQuality:
    """Plain models of the same scenes; None where there is none of one."""

    cover: ImageQuality | None
    secrets: tuple[ImageQuality | None, ...]
    gaussians: tuple[int | None, ...]  # of the plain models of the cover and of the secrets


@dataclass(frozen=True)
class PsnrRange:
    """PSNR in dB over several wrong keys."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class WrongKeys:
    """What decoders make of wrong embeddings, against test views."""

    keys: int
    vs_cover: PsnrRange  # means over the decoders
    vs_secrets: tuple[PsnrRange, ...]  # each decoder's, seen from the cameras of its secret


@dataclass(frozen=True)
class RenderFidelity:
    """Renders of a model against those of the plain model that it should show, from test cameras."""

    psnr: float  # dB, of the mean square error over all views; at most 120
    nothing: float  # dB, what empty pictures would come to


@dataclass(frozen=True)
class HidingQuality:
    """Cover and secrets on their test views, and what they are to be compared with."""

    cover: ImageQuality
    secrets: tuple[ImageQuality, ...]
    baseline: BaselineQuality
    wrong_key: WrongKeys | None  # None where keys condition no decoder
    chance_level: tuple[float, ...]  # dB, the stego model itself against each secret's test views


def measure_hiding(
    stego: Gaussians,
    opened: Sequence[Opened],
    scenes: Sequence[Scene],  # the cover, then the secrets in the order of `opened`, each in its own frame
    baselines: Sequence[Gaussians | None],  # plain models of the scenes, each in its own frame
    *,
    wrong_keys: int = WRONG_KEYS,
    seed: int = 0,
) -> HidingQuality:
    """Qualities of cover and secrets, of plain models, and what wrong keys show.

    Wrong keys are embeddings drawn as those of random keys fall. Only somebody who has a decoder but not its
    key would see what they show; it should look like the cover, that is, be at the chance level.
    Raises UsageError for no wrong keys at all.
    """
    if wrong_keys < 1:
        raise UsageError(f"expected at least one wrong key, got {wrong_keys}")
    cover, secrets = scenes[0], scenes[1:]
    revealed = [each.reveal(stego).to(stego.device) for each in opened]
    wrong = random_embeddings(wrong_keys, torch.Generator().manual_seed(seed))
    plain_cover, *plain_secrets = (
        None if model is None else _quality(scene, model)
        for scene, model in zip(scenes, baselines, strict=True)
    )
    return HidingQuality(
        cover=_quality(cover, stego),
        secrets=tuple(_quality(secret, model) for secret, model in zip(secrets, revealed, strict=True)),
        baseline=BaselineQuality(
            plain_cover,
            tuple(plain_secrets),
            tuple(None if model is None else len(model) for model in baselines),
        ),
        wrong_key=what_wrong_keys_show(stego, opened, scenes, wrong),
        chance_level=tuple(
            _psnr_in(secret, frame_of(each, secret, cover).inverse().apply_gaussians(stego))
            for each, secret in zip(opened, secrets, strict=True)
        ),
    )


@torch.no_grad()
def what_wrong_keys_show(
    stego: Gaussians, opened: Sequence[Opened], scenes: Sequence[Scene], embeddings: Tensor
) -> WrongKeys | None:
    """PSNRs of what the decoders make of embeddings [E, 64] that are not theirs; None without decoders."""
    cover = scenes[0]
    decoders = [
        (each.decode, frame_of(each, secret, cover), secret)
        for each, secret in zip(opened, scenes[1:], strict=True)
        if each.decode is not None
    ]
    if not decoders:
        return None
    vs_cover: list[list[float]] = []
    vs_secrets: list[list[float]] = []
    for decode, frame, secret in decoders:
        vs_cover.append([])
        vs_secrets.append([])
        for embedding in embeddings:  # one model at a time: they are large
            shown = decode(stego, embedding)
            vs_cover[-1].append(_psnr_in(cover, shown))
            vs_secrets[-1].append(_psnr_in(secret, frame.inverse().apply_gaussians(shown)))
    means = [fmean(each) for each in zip(*vs_cover, strict=True)]
    return WrongKeys(len(embeddings), _range(means), tuple(map(_range, vs_secrets)))


def frame_of(opened: Opened, secret: Scene, cover: Scene) -> Similarity:
    """From the secret's frame into the cover's; where it never was there, to where the cameras fit best."""
    if opened.frame is not None:
        return opened.frame
    return align([view.camera for view in secret.train], [view.camera for view in cover.train])


@torch.no_grad()
def render_fidelity(model: Gaussians, plain: Gaussians, scene: Scene) -> RenderFidelity:
    """How near a model comes to the plain model of its scene, where no photo says anything about either."""
    background = scene.background.to(model.device)
    errors, empty = [], []
    for view in subsample_views(scene.test, _FIDELITY_VIEWS):
        expected = render(plain, view.camera, background).clamp(0, 1)
        errors.append((render(model, view.camera, background).clamp(0, 1) - expected).square().mean())
        empty.append((background - expected).square().mean())
    psnr, nothing = (-10 * torch.stack(each).mean().clamp_min(1e-12).log10() for each in (errors, empty))
    return RenderFidelity(round(float(psnr), 2), round(float(nothing), 2))


def _range(values: Sequence[float]) -> PsnrRange:
    return PsnrRange(fmean(values), min(values), max(values))


def _quality(scene: Scene, model: Gaussians) -> ImageQuality:
    return quality(model, scene.test, scene.background.to(model.device))


def _psnr_in(scene: Scene, model: Gaussians) -> float:
    return mean_psnr(model, scene.test, scene.background.to(model.device))
