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
from keyss.core.scene import Scene, View
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import (
    ImageQuality,
    mean_psnr,
    mean_quality,
    subsample_views,
    view_quality,
)
from keyss.keys import random_embeddings
from keyss.methods.base import Opened
from keyss.rendering import render

WRONG_KEYS = 32
_FIDELITY_VIEWS = 8


@dataclass(frozen=True)
class BaselineQuality:
    """Plain 3DGS of the same scenes; None where there is none of one.

    A bound only where `equal`: of as many Gaussians and as many training steps. Else it is the plain model
    from which the training of the scene went on.
    """

    cover: ImageQuality | None
    secrets: tuple[ImageQuality | None, ...]
    gaussians: tuple[int | None, ...]  # of the plain models of the cover and of the secrets
    steps: tuple[int | None, ...] = ()  # of their training; None: they were given, and it is not known
    equal: tuple[bool, ...] = ()  # whether that is as long as the scene itself was trained, in all


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
class Shown:
    """What a model shows on the test views of its scene, and the plain model beside it."""

    quality: ImageQuality
    plain: ImageQuality | None  # None, and what follows, where there is no plain model
    fidelity: RenderFidelity | None


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
    steps: Sequence[int | None] = (),  # of the baselines, and whether their scenes had as many
    equal: Sequence[bool] = (),
    wrong_keys: int = WRONG_KEYS,
    seed: int = 0,
    shown: Sequence[Shown] | None = None,  # of stego model and secrets, where it is known: they are not drawn
) -> HidingQuality:
    """Qualities of cover and secrets, of plain models, and what wrong keys show.

    Wrong keys are embeddings drawn as those of random keys fall. Only somebody who has a decoder but not its
    key would see what they show; it should look like the cover, that is, be at the chance level.
    Raises UsageError for no wrong keys at all.
    """
    if wrong_keys < 1:
        raise UsageError(f"expected at least one wrong key, got {wrong_keys}")
    cover, secrets = scenes[0], scenes[1:]
    wrong = random_embeddings(wrong_keys, torch.Generator().manual_seed(seed))
    if shown is None:
        models = [stego, *(each.reveal(stego).to(stego.device) for each in opened)]
        shown = list(map(show, models, baselines, scenes))
    return HidingQuality(
        cover=shown[0].quality,
        secrets=tuple(each.quality for each in shown[1:]),
        baseline=BaselineQuality(
            shown[0].plain,
            tuple(each.plain for each in shown[1:]),
            tuple(None if model is None else len(model) for model in baselines),
            tuple(steps),
            tuple(equal),
        ),
        wrong_key=what_wrong_keys_show(stego, opened, scenes, wrong),
        chance_level=tuple(
            _psnr_in(secret, stego, frame_of(each, secret, cover))
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
            vs_secrets[-1].append(_psnr_in(secret, shown, frame))
    means = [fmean(each) for each in zip(*vs_cover, strict=True)]
    return WrongKeys(len(embeddings), _range(means), tuple(map(_range, vs_secrets)))


def frame_of(opened: Opened, secret: Scene, cover: Scene) -> Similarity:
    """From the secret's frame into the cover's; where it never was there, to where the cameras fit best."""
    if opened.frame is not None:
        return opened.frame
    return align([view.camera for view in secret.train], [view.camera for view in cover.train])


@torch.no_grad()
def show(model: Gaussians, plain: Gaussians | None, scene: Scene, *, of_plain: bool = False) -> Shown:
    """Both models on the test views of their scene; every picture is drawn once, and none is kept.

    Fidelity is how near a model comes to the plain model, where no photo says anything about either.
    `of_plain`: the scene has no photos, its pictures are of the plain model, and are not drawn again.
    """
    background = scene.background.to(model.device)
    compared = set(map(id, subsample_views(scene.test, _FIDELITY_VIEWS)))
    qualities: list[ImageQuality] = []
    plains: list[ImageQuality] = []
    errors, empty = [], []
    for view in scene.test:
        photo = view.image.to(model.device).float() / 255
        image = render(model, view.camera, background).clamp(0, 1)
        qualities.append(view_quality(image, photo))
        if plain is None:
            continue
        if of_plain and view.drawn is not None:
            expected = view.drawn.to(model.device)
        else:
            expected = render(plain, view.camera, background).clamp(0, 1)
        plains.append(view_quality(expected, photo))
        if id(view) in compared:
            errors.append((image - expected).square().mean())
            empty.append((background - expected).square().mean())
    if plain is None:
        return Shown(mean_quality(qualities), None, None)
    psnr, nothing = (-10 * torch.stack(each).mean().clamp_min(1e-12).log10() for each in (errors, empty))
    fidelity = RenderFidelity(round(float(psnr), 2), round(float(nothing), 2))
    return Shown(mean_quality(qualities), mean_quality(plains), fidelity)


def _range(values: Sequence[float]) -> PsnrRange:
    return PsnrRange(fmean(values), min(values), max(values))


def _psnr_in(scene: Scene, model: Gaussians, frame: Similarity | None = None) -> float:
    """Of a model on the test views of a scene, from whose frame `frame` leads into the model's."""
    views = scene.test
    if frame is not None:
        views = tuple(View(frame.apply_camera(view.camera), view.image) for view in views)
    return mean_psnr(model, views, scene.background.to(model.device))
