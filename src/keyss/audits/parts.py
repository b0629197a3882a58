"""The parts of an audit: what each measures, and against which baseline or control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

from torch import Tensor

from keyss.audits.progress import PartProgress, PartResult
from keyss.audits.record import (
    PICTURES,
    ImagesResult,
    LabelledPicture,
    LeaksResult,
    ParametersResult,
    PicturedView,
    RendersResult,
    RobustnessResult,
    SinkhornResult,
)
from keyss.audits.subject import AuditSubject
from keyss.files.images import picture_names
from keyss.measure.auc import stegexpose_auc
from keyss.measure.distances import against_controls
from keyss.measure.images import compare_images, photos_of, renders_of, steganalysed
from keyss.measure.leaks.attacks import decoder_attack, file_attacks, with_the_key
from keyss.measure.leaks.looking import AttackResult, look_for_secret
from keyss.measure.robustness.survival import breakdown_points, measure_robustness
from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
from keyss.measure.speed import SpeedResult, measure_speed
from keyss.measure.stealth.judging import StealthResult, judge
from keyss.measure.two_sample import two_sample_against_controls
from keyss.runs.files import stego_in

PICTURED_VIEWS = 3

AuditPart = Callable[[AuditSubject, int, PartProgress], PartResult[Any]]


def images(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[ImagesResult]:
    """Cover and secrets against the test views, with plain models as baselines, and some of the images."""
    names = ["cover", *(f"secret-{index}" for index in range(1, len(subject.scenes)))]
    plains = [subject.original, *subject.baselines]
    compared, baselines, pictures, shown = [], [], {}, []
    for index, (name, scene, model, plain) in enumerate(
        zip(names, subject.scenes, subject.models, plains, strict=True)
    ):
        progress(index, len(names))
        role = "secret" if index and len(names) == 2 else name.replace("-", " ")
        reference = "photo" if subject.run.metrics.photos[index] else "given model"
        photos = photos_of(scene.test)
        renders = {"stego model" if index == 0 else "revealed": renders_of(model, scene, scene.test)}
        if plain is not None:
            renders["plain model"] = renders_of(plain, scene, scene.test)
        if index:
            without = subject.frames[index - 1].inverse().apply_gaussians(subject.stego)
            renders["without the key"] = renders_of(without, scene, scene.test)
        compared.append(compare_images(photos, next(iter(renders.values()))))
        baselines.append(compare_images(photos, renders["plain model"]) if plain is not None else None)
        for view in range(len(photos))[:: -(-len(photos) // PICTURED_VIEWS)]:
            items = []
            for label, pictured in {reference: photos, **renders}.items():
                file = f"{name}-{view + 1}-{label.replace(' ', '-')}.png"
                pictures[file] = pictured[view][1]
                items.append(LabelledPicture(label, f"{PICTURES}/{file}"))
            title = f"{role.capitalize()}, {photos[view][0]}"
            shown.append(PicturedView(title, tuple(items)))
    result = ImagesResult(
        cover=compared[0],
        cover_baseline=baselines[0],
        secrets=tuple(compared[1:]),
        secret_baselines=tuple(baselines[1:]),
        gaussians=tuple(len(model) for model in subject.models),
        baseline_gaussians=tuple(None if plain is None else len(plain) for plain in plains),
        pictures=tuple(shown),
    )
    return PartResult(result, pictures)


def parameters(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[ParametersResult]:
    """Distances of the parameters from plain models: 3D-Sinkhorn as published, Wasserstein, a classifier."""
    original, stego, controls = subject.original, subject.stego, subject.controls
    progress(0, 4)
    published = sinkhorn_3d(original, stego)
    quality = subject.run.metrics
    secret_psnr = fmean(each.psnr for each in quality.secrets)
    score = composite_score(quality.cover.psnr, secret_psnr, published.sum)
    between = tuple(sinkhorn_3d(original, control) for control in controls)
    progress(1, 4)
    distances = against_controls(stego, controls, original=original, seed=seed)
    progress(2, 4)
    two_sample = two_sample_against_controls(stego, controls, original=original, seed=seed)
    progress(3, 4)
    sinkhorn = SinkhornResult(published, between, score)
    return PartResult(ParametersResult(sinkhorn, distances, two_sample))


def stealth(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[StealthResult]:
    """Statistics of the file compared with plain models, and whether a guessed secret can be confirmed."""
    progress(0, 1)
    return PartResult(
        judge(subject.stego, subject.controls, original=subject.original, candidates=subject.baselines)
    )


def stegexpose(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[RendersResult]:
    """Whether StegExpose tells renders of the stego model from a plain one's, and of two plain models."""
    views = steganalysed(subject.cover.views)
    models = (subject.controls[0], subject.stego, subject.controls[1])
    plain, stego, control = (
        [image.numpy() for _, image in renders_of(model, subject.cover, views)] for model in models
    )
    names = tuple(picture_names(view.camera for view in views))
    progress(0, 2)
    found = stegexpose_auc(plain, stego)
    progress(1, 2)
    return PartResult(RendersResult(names, found, stegexpose_auc(plain, control)))


def leaks(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[LeaksResult]:
    """What attacks without the key show of each secret, with the file or with its decoder."""
    found: list[tuple[AttackResult, ...]] = []
    pictures: dict[str, Tensor] = {}
    attacks = file_attacks(subject.cover, seed=seed)
    for index, (secret, frame, opened) in enumerate(
        zip(subject.secrets, subject.frames, subject.run.opened, strict=True), start=1
    ):
        progress(index - 1, len(subject.secrets))
        more = []
        if opened.decode is not None:
            more.append(decoder_attack(opened.decode, seed=seed))
            more.append(with_the_key(partial(opened.reveal, frame="cover", force=True)))
        rows, shown = look_for_secret(subject.stego, subject.controls, secret, frame, [*attacks, *more])
        files = [f"leak-{index}-{number:02}.png" for number in range(1, len(rows) + 1)]
        pictures |= {file: shown[row.attack] for file, row in zip(files, rows, strict=True)}
        found.append(
            tuple(replace(row, picture=f"{PICTURES}/{file}") for file, row in zip(files, rows, strict=True))
        )
    return PartResult(LeaksResult(tuple(found)), pictures)


def robustness(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[RobustnessResult]:
    """What changes of the stego model cost the cover and the secrets."""
    rows = measure_robustness(
        subject.stego, subject.reopeners, subject.cover, subject.secrets, seed=seed, progress=progress
    )
    return PartResult(RobustnessResult(tuple(rows), tuple(breakdown_points(rows))))


def speed(subject: AuditSubject, seed: int, progress: PartProgress) -> PartResult[SpeedResult]:
    """Times, sizes, and whether third-party programs read the files."""
    plains = [subject.original, *subject.baselines]
    result = measure_speed(
        stego_in(subject.run.folder),
        subject.reopeners,
        subject.scenes,
        [plain if plain is not None else model for plain, model in zip(plains, subject.models, strict=True)],
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
