"""The parts of an audit: what each measures, and against which baseline or control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

from torch import Tensor

from keyss.audits.numbers import numbered
from keyss.audits.progress import PartProgress, PartResult
from keyss.audits.record import (
    PICTURES,
    ImagesResult,
    ModelImages,
    ParametersResult,
    RendersResult,
)
from keyss.audits.subject import AuditSubject
from keyss.files.images import picture_names
from keyss.measure.distances import against_controls
from keyss.measure.images import compare_images, photos_of, renders_of, steganalysed
from keyss.measure.leaks.attacks import decoder_attack, file_attacks, with_the_key
from keyss.measure.leaks.looking import AttackResult, look_for_secret
from keyss.measure.robustness.survival import ChangeResult, measure_robustness
from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
from keyss.measure.speed import SpeedResult, measure_speed
from keyss.measure.stealth.judging import StealthResult, judge
from keyss.measure.stegexpose import stegexpose_auc
from keyss.measure.two_sample import auc_beside_controls
from keyss.runs.files import stego_in

PICTURED_VIEWS = 3

AuditPart = Callable[[AuditSubject, int, PartProgress], PartResult[Any]]


def images(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[ImagesResult]:
    """Cover and secrets against the test views, with plain models as baselines, and some of the images."""
    models = [subject.stego, *subject.revealed]
    plains = [subject.original, *subject.baselines]
    results = []
    files: dict[str, dict[str, str]] = {}
    pictures: dict[str, Tensor] = {}
    for index, (scene, model, plain) in enumerate(zip(subject.scenes, models, plains, strict=True)):
        progress(index, len(models))
        name = numbered("secret", index - 1, len(models) - 1) if index else "cover"
        has_photos = subject.run.metrics.photos[index]
        photos = photos_of(scene.test)
        own = renders_of(model, scene, scene.test)
        shown = {
            "photo" if has_photos else "given model": photos,
            "revealed" if index else "stego model": own,
        }
        baseline = None
        if plain is not None:
            shown["plain model"] = renders_of(plain, scene, scene.test)
            baseline = compare_images(photos, shown["plain model"])
        if index:
            placed = subject.in_cover[index - 1]
            shown["without the key"] = renders_of(subject.stego, placed, placed.test)
        compared = compare_images(photos, own)
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
    """Distances of the parameters from plain models: 3D-Sinkhorn as published, Wasserstein, a classifier."""
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
    """Statistics of the file compared with plain models, and whether a guessed secret can be confirmed."""
    progress(0, 1)
    return PartResult(
        judge(subject.stego, subject.controls, original=subject.original, candidates=subject.baselines)
    )


def stegexpose(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[RendersResult]:
    """StegExpose on renders of the stego model and of plain models."""
    cover = subject.scenes[0]
    views = steganalysed(cover.views)
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
            attacks.append(decoder_attack(opened.decode, seed=seed))
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
    """PSNR that the cover and the secrets lose when the stego model changes."""
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
