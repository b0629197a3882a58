"""What a method's finished run comes to, measured as every other's is.

Of an audit's measures those are taken that are defined for a single file, take less than a minute and say
most: see docs/peers.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from keyss.comparison.record import (
    ComparedMethod,
    SceneScores,
    Secrecy,
    Survival,
    WrongKeysShow,
)
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.measure.images import compare_images, photos_of, renders_of, steganalysed
from keyss.measure.robustness.changes import Change, purification, random_pruning
from keyss.measure.robustness.conversions import converters
from keyss.measure.robustness.survival import robustness
from keyss.measure.roc import stegexpose_roc
from keyss.measure.speed import readers, render_time
from keyss.measure.stealth.judging import StealthResult, judge
from keyss.measure.two_sample import two_sample_auc
from keyss.methods import registry
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import HANDED, stego_in
from keyss.runs.opening import HidingRun

LOST = 0.25  # of the Gaussians
GIVEN_UP = 0.01  # of the blending weight in the cover's views, by purification
CONVERSIONS = ((".spz", "gsply"), ("compressed .ply", "splat-transform"))  # two formats, two programs
_ROUNDS = 5  # of timing pictures
_PRUNED = "pruned"  # head of the column of what a model of any kind can be


@dataclass(frozen=True)
class _Figures:
    """What is found in one model beside the controls."""

    classifier: float | None  # mean AUC
    stealth: StealthResult | None
    stegexpose: float  # AUC on renders, against the first control's


@dataclass(frozen=True)
class PlainCovers:
    """Plain models of the cover, that published ones are held against; what they give is worked out once.

    The first is from the seed that all methods have, the others from seeds of their own.
    """

    scene: Scene
    models: Sequence[Gaussians]  # at least three, on the device
    seed: int = 0

    @property
    def controls(self) -> Sequence[Gaussians]:
        """Those from other seeds."""
        return self.models[1:]

    def judged(self, model: Gaussians, standard: bool) -> Secrecy:
        """A published model beside the plain model of its seed; unless `standard`, only its pictures."""
        found, plain = self._figures(model, standard), self._own
        rows = found.stealth.statistics if found.stealth is not None else ()
        return Secrecy(
            classifier=found.classifier,
            classifier_plain=plain.classifier,
            stealth=None if found.stealth is None else found.stealth.least,
            stealth_plain=None if plain.stealth is None else plain.stealth.least,
            stealth_statistic=rows[0].name if rows else None,
            stegexpose=found.stegexpose,
            stegexpose_plain=plain.stegexpose,
        )

    @cached_property
    def _own(self) -> _Figures:
        return self._figures(self.models[0], True)

    def _figures(self, model: Gaussians, standard: bool) -> _Figures:
        return _Figures(
            classifier=self._classifier(model) if standard else None,
            stealth=judge(model, self.controls) if standard else None,
            stegexpose=stegexpose_roc(self._plain_pictures, self._pictures(model)).roc.auc,
        )

    def _classifier(self, model: Gaussians) -> float | None:
        try:
            return fmean(two_sample_auc(each, model, seed=self.seed).auc for each in self.controls)
        except UsageError:  # too small a model, or one in a corner: no measure, and no reason to stop
            return None

    @cached_property
    def _plain_pictures(self) -> list[NDArray[np.uint8]]:
        return self._pictures(self.controls[0])

    def _pictures(self, model: Gaussians) -> list[NDArray[np.uint8]]:
        views = steganalysed(self.scene.views)
        return [image.numpy() for _, image in renders_of(model, self.scene, views)]


def measured(name: str, run: HidingRun, covers: PlainCovers, device: Backend) -> ComparedMethod:
    """The row of a finished run on two scenes with photos."""
    started, target = time.monotonic(), resolve_device(device)
    method = registry.get(run.config.method)
    scenes, stego = run.scenes(train_pictures=False), run.stego.to(target)
    revealed = run.opened[0].reveal(stego).to(target)
    metrics, standard = run.metrics, method.capabilities.standard
    found = []
    for scene, model, plain, own in zip(
        scenes, (stego, revealed), run.plain_models(), (metrics.cover, metrics.secrets[0]), strict=True
    ):
        photos = photos_of(scene.test)
        pictures = renders_of(model, scene, scene.test)
        beside = plain.to(target) if plain is not None else model
        times = render_time(name, model, beside, scene, rounds=_ROUNDS)
        found.append(
            SceneScores(
                psnr=own.psnr,
                ssim=own.ssim,
                lpips=compare_images(photos, pictures, flip=False).mean.lpips_alex,
                render_seconds=times.seconds,
                render_ratio=times.ratio,
            )
        )
    wrong, published = metrics.wrong_key, stego_in(run.folder)
    row = ComparedMethod(
        name=name,
        capabilities=method.capabilities,
        most_secrets=method.most_secrets,
        cover=found[0],
        secret=found[1],
        secrecy=covers.judged(stego, standard),
        wrong_keys=None
        if wrong is None
        else WrongKeysShow(
            cover=wrong.vs_cover.mean, secret=wrong.vs_secrets[0].max, chance=metrics.chance_level[0]
        ),
        survival=survival(run, stego, scenes, standard),
        readers=tuple(readers(published)),
        steps=metrics.iterations,
        trained=metrics.steps,
        gaussians=metrics.gaussians,
        published_bytes=published.stat().st_size,
        handed_bytes=sum(path.stat().st_size for path in (run.folder / HANDED).glob("*")),
        seconds=metrics.seconds,
    )
    return replace(row, measuring_seconds=round(time.monotonic() - started, 1))


def survival(
    run: HidingRun, stego: Gaussians, scenes: Sequence[Scene], standard: bool
) -> tuple[Survival, ...]:
    """What pruning, conversion and purification leave of cover and secret; `stego` on the device."""
    found = []
    possible = {name: change for name, change in trials(scenes[0]).items() if standard or name == _PRUNED}
    _, *results = robustness(stego, run.reopeners, scenes[0], scenes[1:], changes=list(possible.values()))
    by_name = dict(zip(possible, results, strict=True))
    for name, change in trials(scenes[0]).items():
        row = Survival(change=name, sentence=change.sentence)
        if name not in by_name:
            row = replace(row, skipped="it is for 3DGS models, and none is published")
        elif (result := by_name[name]).skipped is not None or result.cover is None:
            row = replace(row, skipped=result.skipped)
        else:
            secret = result.secrets[0]
            loss = secret.loss if secret.opens else None
            row = replace(row, cover_loss=result.cover.loss, secret_loss=loss)
        found.append(row)
    return tuple(found)


def trials(cover: Scene) -> dict[str, Change]:
    """Changes by the heads of their columns. `cover`: its photos serve whoever purifies."""
    known = {(each.format, each.tool): each for each in converters()}
    return {
        _PRUNED: random_pruning(LOST),
        **{each[0]: known[each].change() for each in CONVERSIONS},
        "purified": purification(cover, GIVEN_UP),
    }
