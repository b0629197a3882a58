"""The parts of an audit: functions that measure a run against baselines and controls."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, Generic, TypeVar

import msgspec
import torch
from torch import Tensor

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.atomic import write_bytes
from keyss.files.images import picture_names, png_bytes
from keyss.files.models import read_model
from keyss.files.reading import read_file
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.lab.audits.numbers import numbered
from keyss.lab.audits.record import (
    AUDIT_FILE,
    AUDIT_FOLDER,
    PICTURES,
    Audit,
    ImagesResult,
    ModelImages,
    ParametersResult,
    RendersResult,
    read_audit,
)
from keyss.lab.distances import against_controls
from keyss.lab.leaks.attacks import decoder_attack, file_attacks, with_the_key
from keyss.lab.leaks.leak_scores import AttackResult, look_for_secret
from keyss.lab.robustness.survival import ChangeResult, measure_robustness
from keyss.lab.sinkhorn import composite_score, sinkhorn_3d
from keyss.lab.speed import SpeedResult, measure_speed
from keyss.lab.stealth.judging import StealthResult, judge
from keyss.lab.stegexpose import stegexpose_auc
from keyss.lab.two_sample import auc_beside_controls
from keyss.measure.hide_quality import in_cover
from keyss.measure.image_scores import compare_images, masks_of, photos_of, renders_of, select_views
from keyss.progress import Reporter
from keyss.runs.files import CONTROLS, as_model, stego_in
from keyss.runs.folder import RunFolder
from keyss.runs.json_records import write_record
from keyss.runs.open_run import HidingRun

T = TypeVar("T")
PICTURED_VIEWS = 3


@dataclass(frozen=True)
class AuditSubject:
    """The input of the parts of an audit; models on `device`."""

    run: HidingRun
    scenes: tuple[Scene, ...]  # the cover, then the secrets, each in its own frame
    in_cover: tuple[Scene, ...]  # the secrets with their test cameras in the cover's frame
    stego: Gaussians
    revealed: tuple[Gaussians, ...]  # the secrets, in their own frames
    original: Gaussians  # plain model of the cover
    baselines: tuple[Gaussians | None, ...]  # plain models of the secrets, if there are any
    controls: tuple[Gaussians, ...]  # plain models of the cover from other seeds
    seeds: tuple[int, ...]  # seeds of the controls
    device: torch.device


def subject_of(
    run: HidingRun,
    original: Path | str | None,
    controls: int,
    seed: int,
    device: torch.device,
    reporter: Reporter,
    folder: RunFolder,
) -> AuditSubject:
    """Read, reveal and fit the input of an audit; fitted models are kept in the run's `folder` for reuse.

    `original`: a plain model of the cover, by default the run's own. `controls`: number of models to train,
    with seeds derived from the run's and `seed`. Raises UsageError without a plain model of the cover.
    """
    scenes = run.scenes()
    plain, *_ = run.plain_models()
    _, *baselines = run.baselines()
    if original is not None:
        plain = as_model(original)
    if plain is None:
        raise UsageError(f"{run.folder} has no plain model of the cover to compare with: give `original`")
    stego = run.stego.to(device)
    config = run.config.options.fit
    if original is not None or run.config.models_given[0]:  # the run's maximum is not for this model
        config = replace(config, max_gaussians=max(len(plain), 16))
    seeds = tuple(run.config.options.fit.seed_of(f"control {seed + index}") for index in range(controls))
    return AuditSubject(
        run=run,
        scenes=tuple(scenes),
        in_cover=tuple(in_cover(*pair, scenes[0]) for pair in zip(run.opened, scenes[1:], strict=True)),
        stego=stego,
        revealed=tuple(secret.reveal(stego).to(device) for secret in run.opened),
        original=plain.to(device),
        baselines=tuple(None if model is None else model.to(device) for model in baselines),
        controls=tuple(
            _plain_model(scenes[0], replace(config, seed=own), folder, device, reporter).to(device)
            for own in seeds
        ),
        seeds=seeds,
        device=device,
    )


def _plain_model(
    scene: Scene, config: FitConfig, folder: RunFolder, device: torch.device, reporter: Reporter
) -> Gaussians:
    """Fit a plain model of a scene, or read it from the run's folder."""
    made_of = json.dumps({"scene": scene.digest(), "config": asdict(config)}, sort_keys=True)
    name = f"seed-{config.seed}-{hashlib.sha256(made_of.encode()).hexdigest()[:12]}"
    model = f"{CONTROLS}/{name}.ply"
    if (folder.path / model).exists():
        return read_model(folder.path / model)
    checkpoint = folder.checkpoints / f"{name}.safetensors"
    result = fit_scene(
        scene,
        config,
        device=device,
        title=f"plain model of the cover, seed {config.seed}",
        checkpoint=checkpoint,
        resume=True,
        reporter=reporter,
    )
    folder.keep("controls", model, result.gaussians)
    checkpoint.unlink(missing_ok=True)
    return result.gaussians


@dataclass(frozen=True)
class PartResult(Generic[T]):
    """The result of one part of an audit."""

    section: T  # a field of `Audit`
    pictures: dict[str, Tensor] = field(default_factory=dict)  # [H, W, 3] uint8 by file name


class PartialAudit:
    """An unfinished audit and its pictures, in a folder laid out like a run's; only for equal `inputs`."""

    def __init__(self, folder: Path, begun: Audit, inputs: dict[str, object]) -> None:
        self.folder, self.audit = folder, begun
        self.file = folder / AUDIT_FOLDER / AUDIT_FILE
        self.pictures = self.file.parent / PICTURES
        digest = hashlib.sha256(msgspec.json.encode(inputs, order="sorted")).digest()
        path = folder / "inputs.sha256"
        if not path.exists():
            write_bytes(path, digest)
        elif read_file(path, len(digest)) != digest:
            raise InputError(
                f"{folder}: belongs to an audit with other settings or inputs: "
                "give the same ones, or start again with `overwrite=True`"
            )
        if self.file.exists():
            self.audit = replace(read_audit(folder), run=begun.run)

    def add(self, part: str, result: PartResult[Any]) -> None:
        self.pictures.mkdir(parents=True, exist_ok=True)
        for name, picture in result.pictures.items():
            write_bytes(self.pictures / name, png_bytes(picture))
        write_record(self.file, replace(self.audit, **{part: result.section}))
        self.audit = read_audit(self.folder)


class PartProgress:
    """Progress of one part: call it with the number of finished items and the total."""

    def __init__(self, reporter: Reporter, title: str) -> None:
        self._reporter, self._title, self._total = reporter, title, 0

    def __call__(self, done: int, total: int) -> None:
        if not self._total:
            self._reporter.start(self._title, total, 0)
        self._total = total
        self._reporter.update(done, 0, {})

    def finish(self, complete: bool) -> None:
        if self._total:
            if complete:
                self._reporter.update(self._total, 0, {})
            self._reporter.finish()


AuditPart = Callable[[AuditSubject, int, PartProgress], PartResult[Any]]


def images(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[ImagesResult]:
    """Compare cover and secrets with the test views, and plain models as baselines; keep some images."""
    models = [subject.stego, *subject.revealed]
    plains = [subject.original, *subject.baselines]
    results = []
    files: dict[str, dict[str, str]] = {}
    pictures: dict[str, Tensor] = {}
    for index, (scene, model, plain) in enumerate(zip(subject.scenes, models, plains, strict=True)):
        progress(index, len(models))
        name = numbered("secret", index - 1, len(models) - 1) if index else "cover"
        has_photos = subject.run.metrics.photos[index]
        photos, masks = photos_of(scene.test), masks_of(scene.test)
        own = renders_of(model, scene, scene.test)
        shown = {
            "photo" if has_photos else "given model": photos,
            "revealed" if index else "stego model": own,
        }
        baseline = None
        if plain is not None:
            shown["plain model"] = renders_of(plain, scene, scene.test)
            baseline = compare_images(photos, shown["plain model"], masks)
        if index:
            placed = subject.in_cover[index - 1]
            shown["without the key"] = renders_of(subject.stego, placed, placed.test)
        compared = compare_images(photos, own, masks)
        size = None if plain is None else len(plain)
        results.append(ModelImages(name, has_photos, compared, len(model), baseline, size))
        for view in range(len(photos))[:: -(-len(photos) // PICTURED_VIEWS)]:
            title = f"{name.capitalize()}, {photos[view][0]}"
            files[title] = {}
            for label, renders in shown.items():
                file = f"{name}-{view + 1}-{label}.png".replace(" ", "-")
                pictures[file] = renders[view][1]
                files[title][label] = f"{PICTURES}/{file}"
    return PartResult(ImagesResult(tuple(results), files), pictures)


def parameters(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[ParametersResult]:
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
    return PartResult(ParametersResult(sinkhorn, between, score, distances, two_sample))


def stealth(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[StealthResult]:
    """Compare statistics of the file with plain models, and try to confirm guessed secrets."""
    progress(0, 1)
    return PartResult(
        judge(subject.stego, subject.controls, original=subject.original, candidates=subject.baselines)
    )


def stegexpose(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[RendersResult]:
    """StegExpose on renders of the stego model and of plain models."""
    cover = subject.scenes[0]
    views = select_views(cover.views)
    models = (subject.controls[0], subject.stego, subject.controls[1])
    plain, stego, control = (
        [image.numpy() for _, image in renders_of(model, cover, views)] for model in models
    )
    names = tuple(picture_names(view.camera for view in views))
    progress(0, 2)
    auc = stegexpose_auc(plain, stego)
    progress(1, 2)
    return PartResult(RendersResult(names, auc, stegexpose_auc(plain, control)))


def leaks(
    subject: AuditSubject, seed: int, progress: PartProgress
) -> PartResult[tuple[tuple[AttackResult, ...], ...]]:
    """Attacks without the key on each secret, with the file or with its decoder."""
    results: list[tuple[AttackResult, ...]] = []
    pictures: dict[str, Tensor] = {}
    for index, (secret, opened) in enumerate(zip(subject.in_cover, subject.run.opened, strict=True)):
        progress(index, len(subject.in_cover))
        attacks = file_attacks(subject.scenes[0], seed=seed)
        if opened.decode is not None:
            attacks.append(decoder_attack(opened.decode, opened.key_size, seed=seed))
            attacks.append(with_the_key(partial(opened.reveal, frame="cover", force=True)))
        rows, shown = look_for_secret(subject.stego, subject.controls, secret, attacks)
        files = [f"leak-{index + 1}-{number:02}.png" for number in range(1, len(rows) + 1)]
        pictures |= {file: shown[row.attack] for file, row in zip(files, rows, strict=True)}
        pairs = zip(rows, files, strict=True)
        results.append(tuple(replace(row, picture=f"{PICTURES}/{file}") for row, file in pairs))
    return PartResult(tuple(results), pictures)


def robustness(
    subject: AuditSubject, seed: int, progress: PartProgress
) -> PartResult[tuple[ChangeResult, ...]]:
    """PSNR loss of the cover and the secrets when the stego model changes."""
    cover, *secrets = subject.scenes
    rows = measure_robustness(
        subject.stego, subject.run.openers, cover, secrets, seed=seed, progress=progress
    )
    return PartResult(tuple(rows))


def speed(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[SpeedResult]:
    """Rendering and revealing times, and file sizes."""
    models = [subject.stego, *subject.revealed]
    plains = [subject.original, *subject.baselines]
    result = measure_speed(
        stego_in(subject.run.folder),
        subject.run.openers,
        subject.scenes,
        [plain if plain is not None else model for plain, model in zip(plains, models, strict=True)],
        device=subject.device,
        progress=progress,
    )
    return PartResult(result)


# Parts that need a 3DGS model.
OF_3DGS_MODELS = frozenset({"parameters", "stealth", "leaks", "robustness"})

# By field of `Audit`.
PARTS: dict[str, AuditPart] = {
    part.__name__: part for part in (images, parameters, stealth, stegexpose, leaks, robustness, speed)
}
