"""The quality of a hiding on the test views of its scenes: the numbers of `metrics.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import align
from keyss.fitting.image_metrics import ImageQuality, mean_psnr, mean_quality, subsample_views, view_quality
from keyss.kernels.memory import release
from keyss.keys import random_embeddings
from keyss.methods.hidden import HiddenScene
from keyss.rendering import render

WRONG_KEYS = 32
_FIDELITY_VIEWS = 8


@dataclass(frozen=True)
class BaselineQuality:
    """Plain 3DGS of the same scenes; None if a scene has no plain model.

    If `equal`, it has as many Gaussians and training steps, and is an upper bound; else it is the model from
    which training started.
    """

    cover: ImageQuality | None
    secrets: tuple[ImageQuality | None, ...]
    gaussians: tuple[int | None, ...]  # plain models: cover, then secrets
    steps: tuple[int | None, ...]  # training steps of the plain models; None: given, unknown
    equal: tuple[bool, ...]  # whether the scene had as many steps in total


@dataclass(frozen=True)
class PsnrRange:
    """PSNR in dB over several wrong keys."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class WrongKeys:
    """PSNRs of decoded models under wrong embeddings, on test views."""

    keys: int
    vs_cover: PsnrRange  # means over the decoders
    vs_secrets: tuple[PsnrRange, ...]  # per decoder, on its secret's cameras


@dataclass(frozen=True)
class RenderFidelity:
    """Renders of a model against renders of its plain model, on test cameras."""

    psnr: float  # dB, from the mean squared error over at most 8 views; at most 120
    nothing: float  # dB, empty renders against those of the plain model


@dataclass(frozen=True)
class Shown:
    """The quality of a model on the test views of its scene, and of the plain model."""

    quality: ImageQuality
    plain: ImageQuality | None  # None without a plain model, like `fidelity`
    fidelity: RenderFidelity | None


@torch.no_grad()
def measure_without_keys(
    stego: Gaussians,
    opened: Sequence[HiddenScene],
    scenes: Sequence[Scene],  # the cover, then the secrets in the order of `opened`, each in its own frame
    *,
    wrong_keys: int = WRONG_KEYS,
    seed: int,
) -> tuple[WrongKeys | None, tuple[float, ...]]:
    """Measure what wrong keys show, and chance: PSNRs in dB of the stego model on each secret's test views.

    Wrong keys are embeddings sampled like those of random keys. An attacker with a decoder but no key sees
    the models they decode to, which should look like the cover: PSNRs at the chance level. None without a
    decoder. Raises UsageError if `wrong_keys` is less than 1.
    """
    if wrong_keys < 1:
        raise UsageError(f"expected at least one wrong key, got {wrong_keys}")
    placed = [in_cover(*pair, scenes[0]) for pair in zip(opened, scenes[1:], strict=True)]
    chance = tuple(_psnr(stego, scene) for scene in placed)
    vs_cover, vs_secrets = [], []
    for secret, scene in zip(opened, placed, strict=True):
        if secret.decode is None:
            continue
        embeddings = random_embeddings(wrong_keys, torch.Generator().manual_seed(seed), secret.key_size)
        # One model at a time: they are large.
        models = (secret.decode(stego, embedding) for embedding in embeddings)
        pairs = [(_psnr(model, scenes[0]), _psnr(model, scene)) for model in models]
        vs_cover.append([of_cover for of_cover, _ in pairs])
        vs_secrets.append(_range([of_secret for _, of_secret in pairs]))
    if not vs_cover:
        return None, chance
    means = [fmean(psnrs) for psnrs in zip(*vs_cover, strict=True)]
    return WrongKeys(wrong_keys, _range(means), tuple(vs_secrets)), chance


def in_cover(opened: HiddenScene, secret: Scene, cover: Scene) -> Scene:
    """The secret's scene with its test cameras in the cover's frame.

    A secret without a frame there is placed by aligning its training cameras with the cover's.
    """
    frame = opened.frame
    if frame is None:
        frame = align([view.camera for view in secret.train], [view.camera for view in cover.train])
    moved = tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in secret.test)
    return replace(secret, test=moved)


@torch.no_grad()
def compare(model: Gaussians, plain: Gaussians | None, scene: Scene, *, of_plain: bool = False) -> Shown:
    """Compare both models with the test views of their scene, rendering each view once.

    Fidelity compares the model with the plain model, without photos. `of_plain`: the scene has no photos; its
    images are renders of the plain model, which is then not needed.
    """
    background = scene.background.to(model.device)
    plain = None if plain is None else plain.to(model.device)
    compared = set(map(id, subsample_views(scene.test, _FIDELITY_VIEWS)))
    qualities: list[ImageQuality] = []
    plains: list[ImageQuality] = []
    errors, empty = [], []
    for view in scene.test:
        image = render(model, view.camera, background).clamp(0, 1)
        qualities.append(view_quality(image, view))
        if of_plain and view.unrounded is not None:
            expected = view.unrounded.to(model.device)
        elif plain is None:
            continue
        else:
            expected = render(plain, view.camera, background).clamp(0, 1)
        plains.append(view_quality(expected, view))
        if id(view) in compared:
            errors.append((image - expected).square().mean())
            empty.append((background - expected).square().mean())
    release()
    if not plains:
        return Shown(mean_quality(qualities), None, None)
    psnr, nothing = (-10 * torch.stack(mses).mean().clamp_min(1e-12).log10() for mses in (errors, empty))
    fidelity = RenderFidelity(round(float(psnr), 2), round(float(nothing), 2))
    return Shown(mean_quality(qualities), mean_quality(plains), fidelity)


def _range(values: Sequence[float]) -> PsnrRange:
    return PsnrRange(fmean(values), min(values), max(values))


def _psnr(model: Gaussians, scene: Scene) -> float:
    return mean_psnr(model, scene.test, scene.background.to(model.device))
