"""The parts of an audit: which measure looks at what, beside which bound or null."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean
from typing import Any

from keyss.audit.histograms import histograms
from keyss.audit.progress import PICTURES, Found, Steps
from keyss.audit.subject import Subject
from keyss.core.errors import BackendError
from keyss.files.images import picture_name
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.distances import against_null, attribute_distances
from keyss.measure.images import compare_images, renders_of
from keyss.measure.leaks import look_for_secret
from keyss.measure.robustness import robustness as survival
from keyss.measure.robustness import verdicts
from keyss.measure.roc import stegexpose_roc
from keyss.measure.sealwatch_detectors import sealwatch_roc
from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
from keyss.measure.speed import speed as measure_speed
from keyss.measure.two_sample import two_sample_against_null, two_sample_auc
from keyss.runs.files import SIDECAR, STEGO

PICTURED_VIEWS = 3
STEGANALYSED_VIEWS = 64

Part = Callable[[Subject, int, Steps], Found]


def images(subject: Subject, seed: int, steps: Steps) -> Found:
    """Cover and secrets against the test photos, beside plain models, and some of the pictures."""
    names = ["cover", *(f"secret-{index}" for index in range(1, len(subject.scenes)))]
    plains = [subject.original, *subject.bounds]
    pairs = list(zip(names, subject.scenes, subject.models, plains, strict=True))
    compared, bounds, pictures, shown = [], [], {}, []
    for index, (name, scene, model, bound) in enumerate(pairs):
        steps(index, len(pairs))
        photos = [(picture_name(view.camera), view.image) for view in scene.test]
        renders = {"published" if index == 0 else "revealed": renders_of(model, scene, scene.test)}
        if bound is not None:
            renders["plain 3DGS"] = renders_of(bound, scene, scene.test)
        if index:
            without = subject.frames[index - 1].inverse().apply_gaussians(subject.stego)
            renders["without the key"] = renders_of(without, scene, scene.test)
        compared.append(compare_images(photos, next(iter(renders.values()))))
        bounds.append(compare_images(photos, renders["plain 3DGS"]) if bound is not None else None)
        for view in range(len(photos))[:: -(-len(photos) // PICTURED_VIEWS)]:
            items = []
            for label, pictured in {"photo": photos, **renders}.items():
                file = f"{name}-{view + 1}-{label.replace(' ', '-')}.png"
                pictures[file] = pictured[view][1]
                items.append({"label": label, "file": f"{PICTURES}/{file}"})
            shown.append(
                {"title": f"{name.replace('-', ' ').capitalize()}, {photos[view][0]}", "items": items}
            )
    result = {
        "cover": compared[0],
        "cover_bound": bounds[0],
        "secrets": compared[1:],
        "secret_bounds": bounds[1:],
    }
    return Found({"images": result, "pictures": shown}, pictures)


def parameters(subject: Subject, seed: int, steps: Steps) -> Found:
    """Distances of the parameters from a plain model's: as published, and such as see something."""
    nulls = subject.nulls
    steps(0, 4)
    published: dict[str, Any] = {
        "stego": sinkhorn_3d(subject.original, subject.stego),
        "null": [sinkhorn_3d(subject.original, plain) for plain in nulls],
    }
    if (score := _score(subject, published["stego"]["sum"])) is not None:
        published["score"] = score
    steps(1, 4)
    distances = against_null(subject.stego, nulls, seed=seed)
    # One plain model may lie further from others than these from each other: where does the cover's own lie?
    own = [attribute_distances(plain, subject.original, seed=seed) for plain in nulls]
    distances["original"] = {
        name: {"ratio": fmean(each[name] for each in own) / found["null"]}
        for name, found in distances["attributes"].items()
        if found["null"]
    }
    steps(2, 4)
    two_sample = two_sample_against_null(subject.stego, nulls, seed=seed)
    steps(3, 4)
    return Found(
        {
            "sinkhorn": published,
            "distances": distances,
            "two_sample": {
                "stego": two_sample["against_plain"],
                "null": two_sample["between_plain"],
                "original": [two_sample_auc(plain, subject.original, seed=seed) for plain in nulls],
            },
            "histograms": histograms(subject.stego, nulls),
        }
    )


def stegexpose(subject: Subject, seed: int, steps: Steps) -> Found:
    """Whether detectors of hidden bits tell pictures of the published model from those of a plain one.

    Beside it, whether they tell those of two plain models apart: some learn any difference.
    """
    # In the order of the photos' names, which is that of the camera's path more often than not.
    ordered = sorted(subject.cover.views, key=lambda view: view.camera.name)
    views = subsample_views(ordered, STEGANALYSED_VIEWS)
    models = (subject.nulls[0], subject.stego, subject.nulls[1])
    plain, stego, null = (
        [image.numpy() for _, image in renders_of(model, subject.cover, views)] for model in models
    )
    names = [picture_name(view.camera) for view in views]
    sections: dict[str, Any] = {}
    for index, (ending, others) in enumerate((("", stego), ("_null", null))):
        steps(index, 2)
        found = stegexpose_roc(plain, others)
        for scores in ("plain", "stego"):
            found[scores] = [{"name": name} | row for name, row in zip(names, found[scores], strict=True)]
        sections[f"stegexpose{ending}"] = found
        try:
            sections[f"sealwatch{ending}"] = sealwatch_roc(plain, others, seed=seed)
        except BackendError as error:
            sections["sealwatch"] = {"missing": str(error)}
    return Found(sections)


def leaks(subject: Subject, seed: int, steps: Steps) -> Found:
    """What somebody without the key sees of each secret, in the file or with its decoder."""
    found, pictures = [], {}
    for index, (secret, frame, opened) in enumerate(
        zip(subject.secrets, subject.frames, subject.run.opened, strict=True), start=1
    ):
        steps(index - 1, len(subject.secrets))
        rows, shown = look_for_secret(
            subject.stego,
            subject.nulls,
            subject.cover,
            secret,
            frame,
            opened=getattr(opened, "secret", None),
            seed=seed,
        )
        for number, row in enumerate(rows, start=1):
            file = f"leak-{index}-{number:02}.png"
            pictures[file] = shown[row["attack"]]
            row["picture"] = f"{PICTURES}/{file}"
        found.append(rows)
    return Found({"leaks": found}, pictures)


def robustness(subject: Subject, seed: int, steps: Steps) -> Found:
    """What changes of the published model cost the cover, and what they cost the secrets."""
    rows = survival(
        subject.stego, subject.reopeners, subject.cover, subject.secrets, seed=seed, progress=steps
    )
    return Found({"robustness": rows, "survival": verdicts(rows)})


def speed(subject: Subject, seed: int, steps: Steps) -> Found:
    """How fast everything is for who uses it, and whether other people's programs read it."""
    plains = [subject.original, *subject.bounds]
    measured = measure_speed(
        subject.run.folder / STEGO,
        subject.reopeners,
        subject.scenes,
        [plain if plain is not None else model for plain, model in zip(plains, subject.models, strict=True)],
        sidecar=None if subject.run.sidecar is None else subject.run.folder / SIDECAR,
        device=subject.device,
        progress=steps,
    )
    rendering = [
        {"model": each["model"], "seconds": each["milliseconds"] / 1000, "ratio": each["ratio"]}
        for each in measured["render"]
    ]
    readers = [
        {
            "reader": each["reader"],
            "file": each["model"],
            "loads": each.get("equal", None if "skipped" in each else False),
            "gaussians": each.get("gaussians"),
            "note": each.get("skipped", each.get("error")),
        }
        for each in measured["readers"]
    ]
    result = {
        "render": rendering,
        "reveal_seconds": max(each["seconds"] for each in measured["reveal"]),
        "files": [{"name": name, "bytes": size} for name, size in measured["files"].items()],
        "readers": readers,
    }
    return Found({"speed": result})


PARTS: dict[str, Part] = {
    part.__name__: part for part in (images, parameters, stegexpose, leaks, robustness, speed)
}


def _score(subject: Subject, distance: float) -> float | None:
    """The paper's composite score (eq. 10) of the cover and the mean secret, where there are photos."""
    found = [each.psnr for each in subject.run.metrics.secrets]
    return composite_score(subject.run.metrics.cover.psnr, fmean(found), distance)
