"""From the parts of an audit to figures; None where there is nothing to draw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from keyss.core.errors import InputError
from keyss.report import figures
from keyss.report.figures import Curve, Interval, Losses
from keyss.report.markup import Html, element
from keyss.report.numbers import number, times
from keyss.report.reading import Part
from keyss.report.survival import UNCHANGED, Survival
from keyss.report.tables import numbered
from keyss.report.verdicts import DISTANCE_RATIO, PROGRAMS, TWO_SAMPLE_AUC, auc_text, rocs

_MOST_MODELS = 100


def distances(attributes: Mapping[str, Part]) -> Html | None:
    """Bars of the ratios to the null."""
    ratios = [
        (name, ratio) for name, part in attributes.items() if (ratio := part.number("ratio")) is not None
    ]
    ratios = [(name, ratio) for name, ratio in ratios if ratio > 0]
    if not ratios:
        return None
    values = ", ".join(f"{name} {times(ratio)}" for name, ratio in ratios)
    return figures.ratio_bars(ratios, DISTANCE_RATIO, f"Distances as multiples of the null: {values}.")


def two_sample(part: Part) -> Html | None:
    """AUCs of the published model against each plain one, and of plain models against each other."""
    groups = (("published", "stego", False), ("plain, null", "null", True))
    rows = []
    for name, key, innocent in groups:
        found = part.parts(key, _MOST_MODELS)
        for index, each in enumerate(found):
            auc = each.number("auc")
            if auc is None:
                continue
            low, high = each.number("low"), each.number("high")
            rows.append(
                Interval(
                    numbered(name, index, len(found)),
                    _share(auc),
                    _share(auc if low is None else low),
                    _share(auc if high is None else high),
                    innocent,
                )
            )
    if not rows:
        return None
    values = ", ".join(f"{row.name} {number(row.value, 2)}" for row in rows)
    return figures.intervals(rows, TWO_SAMPLE_AUC, f"AUC of the classifier, with intervals: {values}.")


def histograms(attributes: Mapping[str, Part]) -> Html | None:
    """One histogram for each attribute. Raises InputError when edges and shares do not fit each other."""
    drawn = []
    for name, each in attributes.items():
        if not each:
            continue
        edges, stego = each.numbers("edges"), each.numbers("stego")
        plain = each.number_lists("plain", _MOST_MODELS)
        rising = all(a < b for a, b in pairwise(edges))
        if not rising or any(len(shares) != len(edges) - 1 for shares in (stego, *plain)):
            raise InputError(f"{each.place}: expected rising edges, and one share fewer in each histogram")
        description = f"Histogram of {name}: the published model, and {len(plain)} plain models."
        drawn.append(figures.histogram(name, edges, stego, plain, description))
    return element("div", *drawn, class_="plots") if drawn else None


def roc(audit: Part) -> Html | None:
    """The curves of detectors on renders. Raises InputError when fpr and tpr do not fit each other."""
    curves, values = [], []
    for name, part in [found for key in PROGRAMS for found in rocs(audit, key)]:
        x, y = part.numbers("fpr"), part.numbers("tpr")
        if len(x) != len(y):
            raise InputError(f"{part.place}: expected as many fpr as tpr, found {len(x)} and {len(y)}")
        if x:
            curves.append(
                Curve(f"{name}, {number(part.number('auc'), 2)}", [*map(_share, x)], [*map(_share, y)])
            )
            values.append(f"{name} AUC {auc_text(part)}")
    return figures.roc(curves, f"ROC curves: {', '.join(values)}.") if curves else None


def losses(rows: Sequence[Survival]) -> Html | None:
    """For each secret, what attacks cost it against what they cost the cover."""
    count = max((len(row.secrets) for row in rows), default=0)
    drawn = []
    for index in range(count):
        curves = _curves(rows, index)
        if curves:
            name = numbered("secret", index, count)
            names = ", ".join(curve.name for curve in curves[:20])
            drawn.append(figures.losses(name, curves, f"Loss of the {name} against the cover's: {names}."))
    return element("div", *drawn, class_="plots") if drawn else None


def _curves(rows: Sequence[Survival], index: int) -> list[Losses]:
    """One for each kind of attack, through its strengths."""
    points: dict[str, list[tuple[float, float | None]]] = {}
    for row in rows:
        if row.attack == UNCHANGED or index >= len(row.secrets):
            continue
        x, secret = row.cover.loss, row.secrets[index]
        y = secret.loss if secret.opens else None
        if x is None or not math.isfinite(x) or (secret.opens and (y is None or not math.isfinite(y))):
            continue
        points.setdefault(row.attack, []).append((x, y))
    return [Losses(name, found) for name, found in points.items()]


def _share(value: float) -> float:
    return min(max(value, 0.0), 1.0)
