"""From the parts of an audit to figures; None where there is nothing to draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from markupsafe import Markup

from keyss.core.errors import InputError
from keyss.measure.distances import AttributeDistance
from keyss.measure.histograms import Histogram
from keyss.measure.robustness.survival import UNCHANGED, ChangeResult
from keyss.measure.two_sample import TwoSample
from keyss.report import figures
from keyss.report.figures import AttackCurve, Interval, RocCurve
from keyss.report.numbers import number, numbered, times
from keyss.report.verdicts import DISTANCE_RATIO, TWO_SAMPLE_AUC, DetectorRocs, auc_text

_MOST_DRAWN = 100


def distances(attributes: Mapping[str, AttributeDistance]) -> Markup | None:
    """Bars of the ratios to the seed-to-seed variation."""
    ratios = [(name, each.ratio) for name, each in attributes.items() if each.ratio][:_MOST_DRAWN]
    if not ratios:
        return None
    values = ", ".join(f"{name} {times(ratio)}" for name, ratio in ratios)
    description = f"Distances as multiples of the seed-to-seed variation: {values}."
    return figures.ratio_bars(ratios, DISTANCE_RATIO, description)


def two_sample(found: TwoSample) -> Markup | None:
    """AUCs of the published model against each control, and of controls against each other."""
    groups = (("published", found.stego), ("controls", found.control))
    rows = [
        Interval(
            numbered(name, index, len(aucs)),
            _share(each.auc),
            _share(each.low),
            _share(each.high),
            name != "published",
        )
        for name, aucs in groups
        for index, each in enumerate(aucs[:_MOST_DRAWN])
    ]
    if not rows:
        return None
    values = ", ".join(f"{row.name} {number(row.value, 2)}" for row in rows)
    return figures.intervals(rows, TWO_SAMPLE_AUC, f"AUC of the classifier, with intervals: {values}.")


def histograms(quantities: Mapping[str, Histogram]) -> list[Markup]:
    """One histogram for each quantity."""
    return [
        figures.histogram(
            name,
            each.edges,
            each.stego,
            each.controls[:_MOST_DRAWN],
            f"Histogram of {name}: the published model, and {len(each.controls)} plain models.",
        )
        for name, each in list(quantities.items())[:_MOST_DRAWN]
    ]


def roc(detectors: Sequence[DetectorRocs]) -> Markup | None:
    """The curves of detectors on renders. Raises InputError when fpr and tpr do not fit each other."""
    curves, values = [], []
    for each in detectors:
        x, y = each.published.fpr, each.published.tpr
        if len(x) != len(y):
            raise InputError(f"{each.name}: expected as many fpr as tpr, found {len(x)} and {len(y)}")
        name = f"{each.name}, {number(each.published.auc, 2)}"
        curves.append(RocCurve(name, [*map(_share, x)], [*map(_share, y)]))
        values.append(f"{each.name} AUC {auc_text(each.published)}")
    return figures.roc(curves, f"ROC curves: {', '.join(values)}.") if curves else None


def losses(rows: Sequence[ChangeResult]) -> list[Markup]:
    """For each secret, what attacks cost it against what they cost the cover."""
    count = max((len(row.secrets) for row in rows), default=0)
    drawn = []
    for index in range(min(count, _MOST_DRAWN)):
        name = numbered("secret", index, count)
        if curves := _curves(rows, index)[:_MOST_DRAWN]:
            names = ", ".join(curve.name for curve in curves[:20])
            drawn.append(figures.losses(name, curves, f"Loss of the {name} against the cover's: {names}."))
    return drawn


def _curves(rows: Sequence[ChangeResult], index: int) -> list[AttackCurve]:
    """One for each kind of attack, through its strengths."""
    points: dict[str, list[tuple[float, float | None]]] = {}
    for row in rows:
        if row.attack != UNCHANGED and row.cover is not None and index < len(row.secrets):
            secret = row.secrets[index]
            points.setdefault(row.attack, []).append((row.cover.loss, secret.loss if secret.opens else None))
    return [AttackCurve(name, found) for name, found in points.items()]


def _share(value: float) -> float:
    return min(max(value, 0.0), 1.0)
