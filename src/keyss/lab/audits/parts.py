"""The parts of an audit: functions that measure a run against baselines and controls, and their results."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View
from keyss.files.models import read_model
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import ImageQuality, mean_quality, subsample_views, view_quality
from keyss.fitting.plain import fit_scene
from keyss.lab.auc import Auc
from keyss.lab.distances import AttributeDistance, Sinkhorn3D, against_controls, composite_score, sinkhorn_3d
from keyss.lab.leaks.attacks import decoder_attack, file_attacks
from keyss.lab.leaks.leak_scores import AttackResult, look_for_secret
from keyss.lab.robustness.survival import ChangeResult, measure_robustness
from keyss.lab.stealth.judging import StealthResult, judge
from keyss.lab.stegexpose import stegexpose_auc
from keyss.lab.two_sample import two_sample_auc
from keyss.measure.hide_quality import in_cover
from keyss.measure.renders import renders_of, select_views
from keyss.methods import registry
from keyss.methods.method import role_of
from keyss.progress import Reporter
from keyss.rendering import render
from keyss.runs.files import CONTROLS
from keyss.runs.folder import RunFolder
from keyss.runs.open_run import HidingRun

PICTURED_VIEWS, TIMED_VIEWS = 3, 4

Progress = Callable[[int, int], None]  # called with the number of finished items and the total
Pictures = dict[str, Tensor]  # [H, W, 3] uint8 by file name
# Returns a field of `Audit`, and pictures.
AuditPart = Callable[["Subject", int, Progress], tuple[Any, Pictures]]


@dataclass
class Subject:
    """A run, and data that its measures share; models on `device`."""

    run: HidingRun
    device: torch.device
    controls: Sequence[Gaussians] = ()  # plain models of the cover from other seeds

    @property
    def standard(self) -> bool:
        """True if the published file is a 3DGS model."""
        return registry.get(self.run.config.method).capabilities.standard

    @cached_property
    def scenes(self) -> list[Scene]:
        """The cover, then the secrets, each in its own frame."""
        return self.run.scenes()

    @cached_property
    def in_cover(self) -> list[Scene]:
        """The secrets with their test cameras in the cover's frame."""
        cover, *secrets = self.scenes
        return [in_cover(*pair, cover) for pair in zip(self.run.opened, secrets, strict=True)]

    @cached_property
    def stego(self) -> Gaussians:
        """The published model."""
        return self.run.stego.to(self.device)

    @cached_property
    def revealed(self) -> list[Gaussians]:
        """The secrets, in their own frames."""
        return [secret.reveal(self.stego).to(self.device) for secret in self.run.opened]

    @cached_property
    def original(self) -> Gaussians:
        """The plain model of the cover. Raises InputError without one."""
        plain, *_ = self.run.plain_models()
        if plain is None:
            raise InputError(f"{self.run.folder}: expected the plain model of the cover, found none")
        return plain.to(self.device)

    @cached_property
    def baselines(self) -> list[Gaussians | None]:
        """Plain models of the secrets; None for missing ones."""
        _, *models = self.run.baselines()
        return [None if model is None else model.to(self.device) for model in models]

    @property
    def shown(self) -> list[tuple[Scene, Gaussians, Gaussians | None]]:
        """The scene, the model and the plain model of the cover and of each secret."""
        models, plains = [self.stego, *self.revealed], [self.original, *self.baselines]
        return list(zip(self.scenes, models, plains, strict=True))

    def fit_controls(self, seeds: Sequence[int], folder: RunFolder, reporter: Reporter) -> None:
        """Fit plain models of the cover with these seeds; they are kept in the run's `folder` for reuse.

        Raises InputError without a plain model of the cover.
        """
        config, count = self.run.config.options.fit, len(self.original)
        if self.run.config.models_given[0]:  # the run's maximum is not for this model
            config = replace(config, max_gaussians=max(count, 16))
        configs = [replace(config, seed=seed) for seed in seeds]
        self.controls = [self._fit_control(each, folder, reporter).to(self.device) for each in configs]

    def _fit_control(self, config: FitConfig, folder: RunFolder, reporter: Reporter) -> Gaussians:
        """Fit a plain model of the cover, or read it from the run's folder."""
        cover = self.scenes[0]
        inputs = json.dumps({"scene": cover.digest(), "config": asdict(config)}, sort_keys=True)
        name = f"seed-{config.seed}-{hashlib.sha256(inputs.encode()).hexdigest()[:12]}"
        model = f"{CONTROLS}/{name}.ply"
        if (folder.path / model).exists():
            return read_model(folder.path / model)
        checkpoint = folder.checkpoints / f"{name}.safetensors"
        result = fit_scene(
            cover,
            config,
            device=self.device,
            title=f"plain model of the cover, seed {config.seed}",
            checkpoint=checkpoint,
            resume=True,
            reporter=reporter,
        )
        folder.keep("controls", model, result.gaussians)
        checkpoint.unlink(missing_ok=True)
        return result.gaussians


@dataclass(frozen=True)
class ImageComparison:
    """8-bit renders of a model against the test views."""

    views: dict[str, ImageQuality]  # by name
    mean: ImageQuality  # over the views


@dataclass(frozen=True)
class ModelImages:
    """The stego model or a revealed secret against the test views of its scene, beside a plain model."""

    scene: str  # "cover", "secret", or "secret N" of several
    photos: bool  # False: test views are renders of a given model
    images: ImageComparison
    gaussians: int
    baseline: ImageComparison | None = None  # plain model; None without one, like `baseline_gaussians`
    baseline_gaussians: int | None = None


@dataclass(frozen=True)
class ImagesResult:
    """Cover and secrets against the test views."""

    models: tuple[ModelImages, ...]  # cover, then secrets
    pictures: dict[str, dict[str, str]]  # files of PICTURES by view and by model


@dataclass(frozen=True)
class TwoSampleAucs:
    """Classifier AUCs of the stego model and of plain models."""

    stego: tuple[Auc, ...]  # each control against the stego model
    control: tuple[Auc, ...]  # each pair of controls: seed-to-seed variation
    original: tuple[Auc, ...]  # each control against the cover's own plain model


@dataclass(frozen=True)
class ParametersResult:
    """Distances of the stego model's parameters from those of plain models."""

    sinkhorn: Sinkhorn3D  # published model against the cover's plain model
    sinkhorn_controls: tuple[Sinkhorn3D, ...]
    score: float  # composite score (KeySS, eq. 10)
    distances: dict[str, AttributeDistance]
    two_sample: TwoSampleAucs


@dataclass(frozen=True)
class StegExposeResult:
    """StegExpose on renders."""

    stego: Auc  # the stego model against a control
    control: Auc  # one control against another


@dataclass(frozen=True)
class RenderTime:
    """The time of one render of a model."""

    seconds: float  # median
    ratio: float  # median over pairs of renders, relative to a plain model of the scene; cancels other load


def images(subject: Subject, seed: int, progress: Progress) -> tuple[ImagesResult, Pictures]:
    """Compare cover and secrets with the test views, and plain models as baselines; keep some images."""
    results = []
    files: dict[str, dict[str, str]] = {}
    pictures: Pictures = {}
    for index, (scene, model, plain) in enumerate(subject.shown):
        progress(index, len(subject.scenes))
        name, has_photos = role_of(index, len(subject.scenes)), subject.run.metrics.photos[index]
        own = renders_of(model, _cameras(scene.test), scene.background)
        result = ModelImages(name, has_photos, _compare(own, scene), len(model))
        shown = {
            "photo" if has_photos else "given model": [(view.camera.name, view.image) for view in scene.test],
            "revealed" if index else "stego model": own,
        }
        if plain is not None:
            shown["plain model"] = renders = renders_of(plain, _cameras(scene.test), scene.background)
            result = replace(result, baseline=_compare(renders, scene), baseline_gaussians=len(plain))
        if index:
            placed = subject.in_cover[index - 1]
            shown["without the key"] = renders_of(subject.stego, _cameras(placed.test), placed.background)
        results.append(result)
        for view in range(len(own))[:: -(-len(own) // PICTURED_VIEWS)]:
            title = f"{name.capitalize()}, {own[view][0]}"
            files[title] = {}
            for label, images in shown.items():
                file = f"{name}-{view + 1}-{label}.png".replace(" ", "-")
                _, pictures[file] = images[view]
                files[title][label] = file
    return ImagesResult(tuple(results), files), pictures


def _compare(renders: Sequence[tuple[str, Tensor]], scene: Scene) -> ImageComparison:
    pairs = zip(renders, scene.test, strict=True)
    views = {name: view_quality(image / 255, view) for (name, image), view in pairs}
    return ImageComparison(views, mean_quality(list(views.values())))


def parameters(subject: Subject, seed: int, progress: Progress) -> tuple[ParametersResult, Pictures]:
    """Distances of the parameters from plain models: published 3D-Sinkhorn, Wasserstein, a classifier."""
    original, stego, controls = subject.original, subject.stego, subject.controls
    progress(0, 3)
    sinkhorn, score = published_distance(subject, stego)
    between = tuple(sinkhorn_3d(original, control) for control in controls)
    progress(1, 3)
    distances = against_controls(stego, controls, original=original, seed=seed)
    progress(2, 3)
    auc = partial(two_sample_auc, seed=seed)
    two_sample = TwoSampleAucs(
        stego=tuple(auc(control, stego) for control in controls),
        control=tuple(auc(*pair) for pair in combinations(controls, 2)),
        original=tuple(auc(control, original) for control in controls),
    )
    return ParametersResult(sinkhorn, between, score, distances, two_sample), {}


def published_distance(subject: Subject, stego: Gaussians) -> tuple[Sinkhorn3D, float]:
    """3D-Sinkhorn from the cover's plain model to `stego`, and the composite score."""
    distance, metrics = sinkhorn_3d(subject.original, stego), subject.run.metrics
    secret = fmean(each.psnr for each in metrics.secrets)
    return distance, composite_score(metrics.cover.psnr, secret, distance.sum)


def stealth(subject: Subject, seed: int, progress: Progress) -> tuple[StealthResult, Pictures]:
    """Compare statistics of the file with plain models."""
    progress(0, 1)
    return judge(subject.stego, subject.controls, original=subject.original), {}


def stegexpose(subject: Subject, seed: int, progress: Progress) -> tuple[StegExposeResult, Pictures]:
    """StegExpose on renders of the stego model and of plain models."""
    progress(0, 1)
    return StegExposeResult(*stegexpose_aucs(subject, [subject.stego, subject.controls[1]])), {}


def stegexpose_aucs(subject: Subject, models: Sequence[Gaussians]) -> list[Auc]:
    """AUCs of StegExpose between renders of the first control and of each of the models."""
    cover = subject.scenes[0]
    views = select_views(cover.views)
    plain, *others = (
        [image.numpy() for _, image in renders_of(model, _cameras(views), cover.background)]
        for model in (subject.controls[0], *models)
    )
    return [stegexpose_auc(plain, renders) for renders in others]


def leaks(
    subject: Subject, seed: int, progress: Progress
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


def robustness(subject: Subject, seed: int, progress: Progress) -> tuple[tuple[ChangeResult, ...], Pictures]:
    """PSNR loss of the cover and the secrets when the stego model changes."""
    openers, scenes = subject.run.openers, subject.scenes
    return tuple(measure_robustness(subject.stego, openers, scenes, seed=seed, progress=progress)), {}


@torch.no_grad()
def measure_render_time(model: Gaussians, plain: Gaussians, scene: Scene, *, rounds: int = 15) -> RenderTime:
    """The render time of `model`, beside `plain`, from a scene's test cameras.

    Each round renders at most four views with both, in alternating order; the first round is a warm-up.
    """
    cameras = [view.camera for view in subsample_views(scene.test, TIMED_VIEWS)]
    background = scene.background.to(model.device)
    times = np.zeros((rounds + 1, len(cameras), 2))
    for number in range(rounds + 1):
        for index, camera in enumerate(cameras):
            for which in (0, 1) if (number + index) % 2 else (1, 0):
                start = time.perf_counter()
                render((model, plain)[which], camera, background)
                if model.device.type == "cuda":
                    torch.cuda.synchronize()
                times[number, index, which] = time.perf_counter() - start
    seconds, plain_seconds = times[1:].reshape(-1, 2).T
    return RenderTime(float(np.median(seconds)), float(np.median(seconds / plain_seconds)))


def speed(subject: Subject, seed: int, progress: Progress) -> tuple[dict[str, RenderTime], Pictures]:
    """Rendering times of the stego model and of the revealed secrets."""
    progress(0, 1)
    times = render_times(subject, subject.stego)
    names = ["stego model", *(role_of(index, len(times)) for index in range(1, len(times)))]
    return dict(zip(names, times, strict=True)), {}


def render_times(subject: Subject, stego: Gaussians, *, rounds: int = 15) -> list[RenderTime]:
    """The render times of `stego` and of the revealed secrets; without a plain model, beside themselves."""
    (cover, _, original), *secrets = subject.shown
    return [
        measure_render_time(model, model if plain is None else plain, scene, rounds=rounds)
        for scene, model, plain in [(cover, stego, original), *secrets]
    ]


NEED_A_3DGS_MODEL = frozenset({"parameters", "stealth", "leaks", "robustness"})

# By field of `Audit`.
PARTS: dict[str, AuditPart] = {
    part.__name__: part for part in (images, parameters, stealth, stegexpose, leaks, robustness, speed)
}


def _cameras(views: Sequence[View]) -> list[Camera]:
    return [view.camera for view in views]
