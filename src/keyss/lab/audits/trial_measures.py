"""Measures of a finished hiding for `compare` and `reproduce`, beside those of `hide` and `audit`.

Each is a function from a run to numbers by name. A string instead of a number is the reason why it is
missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import fmean

from keyss.channels import is_appended
from keyss.core.errors import UsageError, import_extra
from keyss.core.gaussians import Gaussians
from keyss.lab.audits import PARTS
from keyss.lab.audits.audit_run import EXTRA
from keyss.lab.audits.parts import published_distance, render_times, stegexpose_aucs
from keyss.lab.audits.subject import Subject
from keyss.lab.robustness.changes import Change, opacity_pruning, purification, random_pruning
from keyss.lab.robustness.converters import converters
from keyss.lab.robustness.survival import ChangedQuality, measure_robustness
from keyss.lab.stealth.judging import judge
from keyss.lab.two_sample import two_sample_auc
from keyss.runs.files import COMPANIONS, stego_in

Numbers = dict[str, float | str]

PRUNED_SHARES = (0.05, 0.10, 0.15, 0.25)  # fractions of the Gaussians
_LOST = 0.25  # fraction of the Gaussians
_GIVEN_UP = 0.01  # fraction of the blending weight in the cover's views that purification removes
CONVERSIONS = ".spz", "compressed .ply"  # formats, written by gsply
_EVERY_VIEW = 10**6
_ROUNDS = 5  # repetitions when timing renders
_WHOLE = "whole"  # the unchanged model
_ROLES = ("cover", "secret")
_ATTRIBUTES = {"opacity": "op", "scale": "sc", "rotation": "ro", "position": "xyz", "colour": "sh"}


def files(subject: Subject) -> Numbers:
    """Megabytes of the published and the companion files."""
    companion = (subject.run.folder / COMPANIONS).glob("*")
    return {
        "published_mb": stego_in(subject.run.folder).stat().st_size / 1e6,
        "companion_mb": sum(path.stat().st_size for path in companion) / 1e6,
    }


def rendering(subject: Subject) -> Numbers:
    """Speed of rendering without appended Gaussians; 1 for a published 3DGS model, else 0."""
    return pictures(subject, own_gaussians(subject.stego)) | {"standard": float(subject.standard)}


def pictures(subject: Subject, stego: Gaussians | None = None) -> Numbers:
    """Speed of rendering the published model (or `stego`) and the first secret."""
    times = render_times(subject, subject.stego if stego is None else stego, rounds=_ROUNDS)
    numbers: Numbers = {}
    for role, time in zip(_ROLES, times, strict=False):
        numbers |= {f"pictures/s, {role}": 1 / time.seconds, f"time over 3DGS, {role}": time.ratio}
    return numbers


def secrecy(subject: Subject) -> Numbers:
    """Detection of the published model among plain models of the cover from other seeds.

    AUC of StegExpose on renders and, if a 3DGS model is published, mean AUC of trees that separate its
    Gaussians from the controls', and minimum p-value of its statistics, corrected for their number.
    """
    stego, controls = subject.stego, subject.controls
    numbers: Numbers = {"stegexpose": stegexpose_aucs(subject, [stego])[0].auc}
    if subject.standard:
        numbers["stealth"] = judge(stego, controls).least
        with suppress(UsageError):  # too few Gaussians, or all in a corner
            numbers["classifier"] = fmean(two_sample_auc(control, stego).auc for control in controls)
    return numbers


def survival(subject: Subject) -> Numbers:
    """Changes in dB of cover and secret by pruning, conversion and purification; none for lost secrets."""
    tools = {(converter.format, converter.tool): converter for converter in converters()}
    changes = {"pruned": random_pruning(_LOST)}
    if subject.standard:
        changes |= {format: tools[format, "gsply"].change() for format in CONVERSIONS}
        changes["purified"] = purification(subject.scenes[0], _GIVEN_UP)
    numbers = _after(subject, changes, lambda quality: 0.0 - quality.loss)
    numbers = {name: value for name, value in numbers.items() if not name.startswith(_WHOLE)}
    if not subject.standard:
        numbers |= dict.fromkeys((*CONVERSIONS, "purified"), "the method publishes no 3DGS model")
    return numbers


def pruning(subject: Subject) -> Numbers:
    """PSNR in dB of the cover and the first secret after pruning; none for lost secrets."""
    kinds = {"by opacity": opacity_pruning, "random": random_pruning}
    changes = {
        f"{share:.0%} {how}": spare_appended(change(share))
        for how, change in kinds.items()
        for share in PRUNED_SHARES
    }
    return _after(subject, changes, lambda quality: quality.psnr, _EVERY_VIEW)


def _after(
    subject: Subject,
    changes: Mapping[str, Change],
    number: Callable[[ChangedQuality], float],
    max_views: int = 8,
) -> Numbers:
    """A number of the quality of cover and first secret after changes, by name; none for lost secrets.

    The first name is that of the unchanged model.
    """
    openers, every = subject.run.openers, list(changes.values())
    results = measure_robustness(subject.stego, openers, subject.scenes, changes=every, max_views=max_views)
    numbers: Numbers = {}
    for name, result in zip([_WHOLE, *changes], results, strict=True):
        if result.skipped is not None:
            numbers[name] = result.skipped
        for role, quality in zip(_ROLES, (result.cover, *result.secrets), strict=False):
            if quality is not None and quality.opens:
                numbers[f"{name}, {role}"] = number(quality)
    return numbers


def sinkhorn(subject: Subject) -> Numbers:
    """3D-Sinkhorn from the cover's plain model to the published one: sum, attributes, composite score."""
    distances, score = published_distance(subject, own_gaussians(subject.stego))
    numbers: Numbers = {f"sinkhorn {short}": getattr(distances, name) for name, short in _ATTRIBUTES.items()}
    return numbers | {"sinkhorn": distances.sum, "score": score}


@dataclass(frozen=True)
class Measure:
    """An entry of the table of measures."""

    numbers: Callable[[Subject], Numbers]
    views: int  # as in `Part`
    modules: tuple[str, ...] = ()  # of the extra `audit`


MEASURES = {
    "files": Measure(files, 1),
    "pictures": Measure(pictures, 8),
    "secrecy": Measure(secrecy, 200, ("sklearn",)),
    "survival": Measure(survival, 150),
    "rendering": Measure(rendering, 16),
    "pruning": Measure(pruning, 300),
    "sinkhorn": Measure(sinkhorn, 40, ("ot",)),
}


def check_extras(measures: Iterable[str]) -> None:
    """Raise BackendError if a package of one of the measures, or parts of an audit, is not installed."""
    for name in measures:
        for module in EXTRA if name in PARTS else MEASURES[name].modules:
            import_extra(module, "audit", f"measure {name}")


def own_gaussians(stego: Gaussians) -> Gaussians:
    """A published model without appended Gaussians."""
    return stego[~is_appended(stego)]


def spare_appended(change: Change) -> Change:
    """The change without appended Gaussians."""

    def apply(model: Gaussians) -> Gaussians:
        appended = is_appended(model)
        if not bool(appended.any()):
            return change(model)
        return Gaussians.cat([change(model[~appended]), model[appended]])

    return replace(change, apply=apply)
