"""The parts of an audit: functions that measure a run against baselines and controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

from torch import Tensor

from keyss.core.scene import Scene
from keyss.fitting.image_metrics import mean_quality, view_quality
from keyss.lab.audits.formatting import numbered
from keyss.lab.audits.record import (
    ImageComparison,
    ImagesResult,
    ModelImages,
    ParametersResult,
    StegExposeResult,
)
from keyss.lab.audits.subject import Subject
from keyss.lab.distances import against_controls
from keyss.lab.leaks.attacks import decoder_attack, file_attacks
from keyss.lab.leaks.leak_scores import AttackResult, look_for_secret
from keyss.lab.render_time import RenderTime, measure_render_time
from keyss.lab.robustness.survival import ChangeResult, measure_robustness
from keyss.lab.sinkhorn import composite_score, sinkhorn_3d
from keyss.lab.stealth.judging import StealthResult, judge
from keyss.lab.stegexpose import stegexpose_auc
from keyss.lab.two_sample import auc_beside_controls
from keyss.measure.renders import renders_of, select_views
from keyss.progress import Reporter

PICTURED_VIEWS = 3


class PartProgress:
    """Progress of one part: call it with the number of finished items and the total."""

    def __init__(self, reporter: Reporter, title: str) -> None:
        self._reporter, self._title, self._total = reporter, title, 0

    def __enter__(self) -> PartProgress:
        return self

    def __call__(self, done: int, total: int) -> None:
        if not self._total:
            self._reporter.start(self._title, total, 0)
        self._total = total
        self._reporter.update(done, 0, {})

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._total:
            if kind is None:
                self._reporter.update(self._total, 0, {})
            self._reporter.finish()


Pictures = dict[str, Tensor]  # [H, W, 3] uint8 by file name
# Returns a field of `Audit`, and pictures.
AuditPart = Callable[[Subject, int, PartProgress], tuple[Any, Pictures]]


def images(subject: Subject, seed: int, progress: PartProgress) -> tuple[ImagesResult, Pictures]:
    """Compare cover and secrets with the test views, and plain models as baselines; keep some images."""
    models = [subject.stego, *subject.revealed]
    plains = [subject.original, *subject.baselines]
    results = []
    files: dict[str, dict[str, str]] = {}
    pictures: Pictures = {}
    for index, (scene, model, plain) in enumerate(zip(subject.scenes, models, plains, strict=True)):
        progress(index, len(models))
        name = numbered("secret", index - 1, len(models) - 1) if index else "cover"
        has_photos = subject.run.metrics.photos[index]
        own = renders_of(model, scene, scene.test)
        shown = {
            "photo" if has_photos else "given model": [view.image for view in scene.test],
            "revealed" if index else "stego model": [image for _, image in own],
        }
        baseline = None
        if plain is not None:
            renders = renders_of(plain, scene, scene.test)
            shown["plain model"] = [image for _, image in renders]
            baseline = _compare(renders, scene)
        if index:
            placed = subject.in_cover[index - 1]
            renders = renders_of(subject.stego, placed, placed.test)
            shown["without the key"] = [image for _, image in renders]
        size = None if plain is None else len(plain)
        results.append(ModelImages(name, has_photos, _compare(own, scene), len(model), baseline, size))
        for view in range(len(own))[:: -(-len(own) // PICTURED_VIEWS)]:
            title = f"{name.capitalize()}, {own[view][0]}"
            files[title] = {}
            for label, images in shown.items():
                file = f"{name}-{view + 1}-{label}.png".replace(" ", "-")
                pictures[file] = images[view]
                files[title][label] = file
    return ImagesResult(tuple(results), files), pictures


def _compare(renders: Sequence[tuple[str, Tensor]], scene: Scene) -> ImageComparison:
    pairs = zip(renders, scene.test, strict=True)
    views = {name: view_quality(image / 255, view) for (name, image), view in pairs}
    return ImageComparison(views, mean_quality(list(views.values())))


def parameters(subject: Subject, seed: int, progress: PartProgress) -> tuple[ParametersResult, Pictures]:
    """Distances of the parameters from plain models: published 3D-Sinkhorn, Wasserstein, a classifier."""
    original, stego, controls = subject.original, subject.stego, subject.controls
    progress(0, 3)
    sinkhorn = sinkhorn_3d(original, stego)
    between = tuple(sinkhorn_3d(original, control) for control in controls)
    quality = subject.run.metrics
    secret_psnr = fmean(secret.psnr for secret in quality.secrets)
    score = composite_score(quality.cover.psnr, secret_psnr, sinkhorn.sum)
    progress(1, 3)
    distances = against_controls(stego, controls, original=original, seed=seed)
    progress(2, 3)
    two_sample = auc_beside_controls(stego, controls, original, seed=seed)
    return ParametersResult(sinkhorn, between, score, distances, two_sample), {}


def stealth(subject: Subject, seed: int, progress: PartProgress) -> tuple[StealthResult, Pictures]:
    """Compare statistics of the file with plain models, and try to confirm guessed secrets."""
    progress(0, 1)
    baselines, original = subject.baselines, subject.original
    return judge(subject.stego, subject.controls, original=original, candidates=baselines), {}


def stegexpose(subject: Subject, seed: int, progress: PartProgress) -> tuple[StegExposeResult, Pictures]:
    """StegExpose on renders of the stego model and of plain models."""
    cover = subject.scenes[0]
    views = select_views(cover.views)
    models = (subject.controls[0], subject.stego, subject.controls[1])
    plain, stego, control = (
        [image.numpy() for _, image in renders_of(model, cover, views)] for model in models
    )
    progress(0, 2)
    auc = stegexpose_auc(plain, stego)
    progress(1, 2)
    return StegExposeResult(auc, stegexpose_auc(plain, control)), {}


def leaks(
    subject: Subject, seed: int, progress: PartProgress
) -> tuple[tuple[tuple[AttackResult, ...], ...], Pictures]:
    """Attacks without the key on each secret, with the file or with its decoder."""
    results: list[tuple[AttackResult, ...]] = []
    pictures: Pictures = {}
    for index, (secret, opened) in enumerate(zip(subject.in_cover, subject.run.opened, strict=True)):
        progress(index, len(subject.in_cover))
        attacks = file_attacks(subject.scenes[0], seed=seed)
        if opened.decode is not None:
            attacks.append(decoder_attack(opened.decode, opened.key_size, seed=seed))
        rows, shown = look_for_secret(subject.stego, subject.controls, secret, attacks)
        files = [f"leak-{index + 1}-{number:02}.png" for number in range(1, len(rows) + 1)]
        pictures |= {file: shown[row.attack] for file, row in zip(files, rows, strict=True)}
        results.append(tuple(replace(row, picture=file) for row, file in zip(rows, files, strict=True)))
    return tuple(results), pictures


def robustness(
    subject: Subject, seed: int, progress: PartProgress
) -> tuple[tuple[ChangeResult, ...], Pictures]:
    """PSNR loss of the cover and the secrets when the stego model changes."""
    cover, *secrets = subject.scenes
    rows = measure_robustness(
        subject.stego, subject.run.openers, cover, secrets, seed=seed, progress=progress
    )
    return tuple(rows), {}


def speed(subject: Subject, seed: int, progress: PartProgress) -> tuple[dict[str, RenderTime], Pictures]:
    """Rendering times of the stego model and of the revealed secrets."""
    models = [subject.stego, *subject.revealed]
    plains = [subject.original, *subject.baselines]
    found: dict[str, RenderTime] = {}
    for index, (scene, model, plain) in enumerate(zip(subject.scenes, models, plains, strict=True)):
        progress(index, len(models))
        name = numbered("secret", index - 1, len(models) - 1) if index else "stego model"
        found[name] = measure_render_time(model, model if plain is None else plain, scene)
    return found, {}


NEED_A_3DGS_MODEL = frozenset({"parameters", "stealth", "leaks", "robustness"})

# By field of `Audit`.
PARTS: dict[str, AuditPart] = {
    part.__name__: part for part in (images, parameters, stealth, stegexpose, leaks, robustness, speed)
}
