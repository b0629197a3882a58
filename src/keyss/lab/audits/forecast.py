"""How long the parts of an audit take, from the records of the run: needs neither keys nor photos' pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import UsageError
from keyss.files.scenes import read_layout
from keyss.lab.robustness.converters import converters
from keyss.lab.robustness.survival import CHANGES, TRAINING_STEPS
from keyss.lab.two_sample import MAX_GAUSSIANS
from keyss.methods import registry
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import IMAGE_SIZE, is_model
from keyss.runs.files import CONFIG, METRICS, PathLike, run_folder
from keyss.runs.json_records import read_record
from keyss.runs.planning import step_seconds
from keyss.runs.run_records import HideMetrics, read_config

_VIEWS = 8  # test views of a model's scene, and most that robustness and leaks render
_PICTURED = 64  # most views that StegExpose judges
_RENDER = 1 / 4  # time of a render over that of a training step
_TIMED = 64  # renders of a model and of its plain model for a time
_ATTACKS = 20  # renders of attacks on the file and on a control
_ATTACK_SECONDS = 3.0  # of attacks without renders
_OPEN_SECONDS = 2.0  # a key on a changed model, which often opens nothing: then every salt is tried
_DECODER_STEPS = 1200  # of the search for the key of a decoder
# Of trees that separate two models: in all, and per Gaussian of their sample.
_TREES_SECONDS, _TREE_SECONDS = 0.6, 1.3e-4
_DISTANCE_SECONDS, _STEALTH_SECONDS = 1e-5, 1.8e-4  # per Gaussian of a model
_PICTURE_SECONDS = 5e-8  # StegExpose, per pixel of a picture


@dataclass(frozen=True)
class AuditForecast:
    """Rough seconds of an audit, by part; "controls" are the plain models to compare with."""

    seconds: Mapping[str, float]
    device: str
    steps: int  # training steps of a control


def forecast_audit(
    run: PathLike, *, controls: int = 3, only: Sequence[str] = (), device: Backend = "auto"
) -> AuditForecast:
    """The time that `audit` takes with these arguments on this device. Raises InputError and UsageError."""
    from keyss.lab.audits.audit_run import chosen_parts

    folder = run_folder(Path(run))
    config, metrics = read_config(folder / CONFIG), read_record(folder / METRICS, HideMetrics)
    kind, fit = resolve_device(device).type, config.options.fit
    standard = registry.get(config.method).capabilities.standard
    counts = [metrics.gaussians, *metrics.secret_gaussians]
    sizes = [
        _views_and_pixels(each, config.views.width, config.views.skip_missing)
        for each in (config.cover, *config.secrets)
    ]
    steps = [step_seconds(kind, count, pixels) for count, (_, pixels) in zip(counts, sizes, strict=True)]
    every = [views for views, _ in sizes]
    few, secrets = [min(each, _VIEWS) for each in every], len(counts) - 1
    training = fit.iterations * step_seconds(kind, fit.max_gaussians, sizes[0][1])
    decoder = _DECODER_STEPS if metrics.wrong_key else 0
    changed = sum(views * step for views, step in zip(few, steps, strict=True)) + _OPEN_SECONDS * secrets
    trees = _TREES_SECONDS + _TREE_SECONDS * min(counts[0], MAX_GAUSSIANS)
    pairs = 2 * controls + math.comb(controls, 2)
    seconds = {
        "controls": controls * training,
        "images": 3 * sum(views * step for views, step in zip(every, steps, strict=True)),
        "parameters": pairs * trees + (controls + 2) * _DISTANCE_SECONDS * counts[0],
        "stealth": (controls + 2) * _STEALTH_SECONDS * counts[0],
        "stegexpose": 3 * _PICTURED * (_RENDER * steps[0] + _PICTURE_SECONDS * sizes[0][1]),
        "leaks": secrets * (_ATTACK_SECONDS + (2 * _ATTACKS * few[0] + decoder) * steps[0]),
        "robustness": (CHANGES + len(converters())) * changed + TRAINING_STEPS * steps[0],
        "speed": 2 * _TIMED * _RENDER * sum(steps),
    }
    parts = ("controls", *chosen_parts(only, standard))
    return AuditForecast({name: 0.1 + seconds[name] for name in parts}, kind, fit.iterations)


def _views_and_pixels(source: str | None, width: int | None, skip_missing: bool) -> tuple[int, int]:
    """The test views of a scene, and the pixels of one. Raises UsageError for a scene in memory."""
    if source is None:
        raise UsageError("the run was made from scenes in memory: there are no photos to audit it against")
    if is_model(source):
        return _VIEWS, (width or IMAGE_SIZE) ** 2
    layout = read_layout(Path(source), skip_missing)
    lens = layout.test[0].lens
    columns = min(width or lens.width, lens.width)
    return len(layout.test), columns * max(1, round(lens.height * columns / lens.width))
