"""From the parts of an audit to figures, None where there is nothing to draw.

They are SVG that is part of the page: its fonts, and colours that follow its light or dark scheme. matplotlib
draws with colours that stand for CSS variables. The same data give the same bytes on every day.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import as_file, files

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keyss.core.errors import InputError
from keyss.measure.distances import AttributeDistance
from keyss.measure.histograms import Histogram
from keyss.measure.robustness.survival import UNCHANGED, ChangeResult
from keyss.measure.two_sample import TwoSample
from keyss.report.numbers import number, numbered, times
from keyss.report.untrusted import clean
from keyss.report.verdicts import DISTANCE_RATIO, TWO_SAMPLE_AUC, DetectorRocs, auc_text

# Each stands for the CSS variable of this name; page.css says what it looks like in light and dark.
_INK, _MUTED, _GRID = "#010101", "#020202", "#030303"
_STEGO, _LIMIT, _PAGE = "#040404", "#050505", "#060609"
_LINES = tuple(f"#06060{index}" for index in range(1, 9))
_VARIABLES = {color: f"--line-{index}" for index, color in enumerate(_LINES, start=1)}
_VARIABLES |= {_INK: "--ink", _MUTED: "--muted", _GRID: "--grid", _PAGE: "--page"}
_VARIABLES |= {_STEGO: "--accent", _LIMIT: "--limit"}
_MARKERS = "osD^vPX*"
_LONGEST_NAME = 28
_WIDTH = 4.2  # inches; on a phone's width text is then about as large as it is here
_MOST_DRAWN = 100

Curve = Sequence[tuple[float, float | None]]  # dB of the cover and of the secret; None: it does not open


def distances(attributes: Mapping[str, AttributeDistance]) -> Markup | None:
    """Ratios to the seed-to-seed variation as bars that start from 1, on a logarithmic axis."""
    ratios = [(name, each.ratio) for name, each in attributes.items() if each.ratio][:_MOST_DRAWN]
    if not ratios:
        return None
    values = [min(max(value, 1e-3), 1e6) for _, value in ratios]

    def draw(axes: Axes) -> None:
        axes.set_xscale("log")
        low, high = min(0.6, *(0.8 * v for v in values)), max(2.0, *(1.15 * v for v in values))
        axes.set_xlim(low, high)
        rows = range(len(values))
        colors = [_STEGO if value > DISTANCE_RATIO else _LINES[0] for value in values]
        axes.barh(rows, [value - 1 for value in values], left=1, height=0.55, color=colors)
        for row, value in zip(rows, values, strict=True):
            axes.annotate(times(value), (1.02, row), xycoords=("axes fraction", "data"), va="center")
        _mark(axes, 1, "controls", DISTANCE_RATIO, [name for name, _ in ratios])
        axes.invert_yaxis()
        ticks = [t for t in (0.01, 0.1, 0.5, 1, 2, 5, 10, 20, 50, 100, 1e3, 1e4, 1e5) if low <= t <= high]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
        axes.set_xlabel("distance from the controls, as a multiple of that between them")

    listed = ", ".join(f"{name} {times(ratio)}" for name, ratio in ratios)
    description = f"Distances as multiples of the seed-to-seed variation: {listed}."
    return _figure("ratios", 0.9 + 0.28 * len(values), description, draw)


def two_sample(found: TwoSample) -> Markup | None:
    """AUCs of the stego model against each control, and of controls against each other."""
    stego, controls = found.stego[:_MOST_DRAWN], found.control[:_MOST_DRAWN]
    names = [numbered("stego model", index, len(found.stego)) for index in range(len(stego))]
    names += [numbered("controls", index, len(found.control)) for index in range(len(controls))]
    if not names:
        return None
    aucs, lows, highs = (
        [_share(getattr(each, name)) for each in (*stego, *controls)] for name in ("auc", "low", "high")
    )

    def draw(axes: Axes) -> None:
        for row, (auc, low, high) in enumerate(zip(aucs, lows, highs, strict=True)):
            color = _STEGO if row < len(stego) else _MUTED
            axes.plot([low, high], [row, row], color=color, linewidth=1.5, solid_capstyle="butt")
            axes.plot([auc], [row], "o", color=color)
        _mark(axes, 0.5, "guessing", TWO_SAMPLE_AUC, names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(min(0.4, min(lows) - 0.02), 1.02)
        axes.set_xlabel("AUC")

    listed = ", ".join(f"{name} {number(auc, 2)}" for name, auc in zip(names, aucs, strict=True))
    description = f"AUC of the classifier, with intervals: {listed}."
    return _figure("two-sample", 0.9 + 0.22 * len(names), description, draw)


def histograms(quantities: Mapping[str, Histogram]) -> list[Markup]:
    """Shares of the Gaussians in bins, by quantity: the stego model filled, each control a line."""
    return [_histogram(name, each) for name, each in list(quantities.items())[:_MOST_DRAWN]]


def _histogram(name: str, shares: Histogram) -> Markup:
    def draw(axes: Axes) -> None:
        axes.stairs(shares.stego, shares.edges, fill=True, color=_STEGO, alpha=0.45, linewidth=0)
        for control in shares.controls[:_MOST_DRAWN]:
            axes.stairs(control, shares.edges, color=_INK, linewidth=0.9, alpha=0.75)
        axes.set_title(_short(name), loc="left", fontsize=9.5)
        axes.set_ylim(bottom=0)
        axes.grid(visible=False)
        axes.spines["left"].set_visible(False)
        axes.set_yticks([])
        axes.margins(x=0.01)

    description = f"Histogram of {name}: the stego model, and {len(shares.controls)} plain models."
    return _figure(f"histogram-{name}", 1.75, description, draw, width=3.2)


def roc(detectors: Sequence[DetectorRocs]) -> Markup | None:
    """The curves of detectors: the share of renders of the stego model found, against false alarms.

    Raises InputError when fpr and tpr do not fit each other.
    """
    if not detectors:
        return None
    for each in detectors:
        x, y = each.stego.fpr, each.stego.tpr
        if len(x) != len(y):
            raise InputError(f"{each.name}: expected as many fpr as tpr, found {len(x)} and {len(y)}")

    def draw(axes: Axes) -> None:
        axes.plot([0, 1], [0, 1], color=_INK, linewidth=1)
        axes.annotate("guessing", (0.62, 0.62), (5, -3), textcoords="offset points", va="top", fontsize=8.5)
        for each, color in zip(detectors, (_STEGO, *_LINES), strict=False):
            x, y = ([*map(_share, shares)] for shares in (each.stego.fpr, each.stego.tpr))
            axes.plot(x, y, color=color, label=_short(f"{each.name}, {number(each.stego.auc, 2)}", 40))
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.01)
        axes.set_aspect("equal")
        axes.set_xlabel("renders of plain models called suspect")
        axes.set_ylabel("renders of the stego model called suspect", rotation_mode="anchor")
        axes.legend(loc="lower right")

    listed = ", ".join(f"{each.name} AUC {auc_text(each.stego)}" for each in detectors)
    return _figure("roc", 3.6, f"ROC curves: {listed}.", draw)


def losses(rows: Sequence[ChangeResult]) -> list[Markup]:
    """For each secret, what attacks cost it (y), against what they cost the cover (x), both in dB.

    Where the secret does not open a hollow mark stands above all others; attacks after which it never does
    are one grey row of them.
    """
    count = max((len(row.secrets) for row in rows), default=0)
    drawn = []
    for index in range(min(count, _MOST_DRAWN)):
        if curves := _curves(rows, index):
            drawn.append(_losses(numbered("secret", index, count), curves))
    return drawn


def _curves(rows: Sequence[ChangeResult], index: int) -> dict[str, Curve]:
    """One for each kind of attack, through its strengths."""
    points: dict[str, list[tuple[float, float | None]]] = {}
    for row in rows:
        if row.attack != UNCHANGED and row.cover is not None and index < len(row.secrets):
            secret = row.secrets[index]
            points.setdefault(row.attack, []).append((row.cover.loss, secret.loss if secret.opens else None))
    return dict(list(points.items())[:_MOST_DRAWN])


def _losses(name: str, curves: Mapping[str, Curve]) -> Markup:
    right = max([1.0, *(x for points in curves.values() for x, _ in points)])
    top = max([1.0, *(y for points in curves.values() for _, y in points if y is not None)])
    lost = 1.15 * top
    survived = {attack: points for attack, points in curves.items() if any(y is not None for _, y in points)}
    fatal = [x for attack, points in curves.items() if attack not in survived for x, _ in points]

    def draw(axes: Axes) -> None:
        end = min(right, top)
        axes.plot([0, end], [0, end], color=_INK, linewidth=1)
        axes.annotate("equal", (end, end), (4, 0), textcoords="offset points", va="center", color=_MUTED)
        if fatal:
            label = "opens at no strength"
            axes.plot(fatal, [lost] * len(fatal), "o", color=_MUTED, markerfacecolor=_PAGE, label=label)
        for index, (attack, points) in enumerate(survived.items()):
            color, marker = _LINES[index % len(_LINES)], _MARKERS[index // len(_LINES) % len(_MARKERS)]
            x, y = [x for x, _ in points], [lost if y is None else y for _, y in points]
            axes.plot(x, y, marker=marker, color=color, linewidth=1.3, label=_short(attack))
            hollow = [x for x, y in points if y is None]
            axes.plot(hollow, [lost] * len(hollow), marker, color=color, markerfacecolor=_PAGE)
        if any(y is None for points in curves.values() for _, y in points):
            _mark_lost(axes, top, lost)
        axes.set_xlabel("cover loses, dB")
        axes.set_ylabel(f"{_short(name)} loses, dB", rotation_mode="anchor")
        axes.figure.legend(loc="outside lower left", ncols=2, columnspacing=1.2, handlelength=1.6)

    rows = math.ceil((len(survived) + bool(fatal)) / 2)
    description = f"Loss of the {name} against the cover's: {', '.join(list(curves)[:20])}."
    return _figure(f"losses-{name}", 3.1 + 0.19 * rows, description, draw)


def _mark_lost(axes: Axes, top: float, lost: float) -> None:
    """A line for secrets that do not open, above an axis that ends at `top`."""
    bottom, _ = axes.get_ylim()
    axes.set_yticks([tick for tick in axes.get_yticks() if bottom <= tick <= top])
    axes.set_ylim(bottom, 1.1 * lost)
    axes.axhline(lost, color=_GRID, linewidth=0.6, zorder=0)
    where = ("axes fraction", "data")
    axes.annotate("does not open", (1, 1.02 * lost), xycoords=where, ha="right", va="bottom", color=_MUTED)


def _figure(
    name: str, height: float, description: str, draw: Callable[[Axes], None], width: float = _WIDTH
) -> Markup:
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of glyphs that its font lacks: the browser's has them
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_style())
        matplotlib.rcParams["svg.hashsalt"] = name
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure.add_subplot())
        written = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(written, format="svg", metadata=nothing)
    figure_of = Markup('<div class="plot" role="img" aria-label="{}">{}</div>')
    return figure_of.format(clean(description), _for_a_page(written.getvalue()))


@cache
def _style() -> matplotlib.RcParams:
    with as_file(files("keyss.report") / "assets" / "figures.mplstyle") as path:
        return matplotlib.rc_params_from_file(path, use_default_template=False)


def _for_a_page(svg: str) -> Markup:
    """matplotlib's SVG without what belongs to a file, and with colours as variables."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' (?:width|height)="[\d.]+pt"', "", svg, count=2)
    svg = re.sub(r"\s*<(metadata|style)\b.*?</\1>", "", svg, flags=re.DOTALL)
    used = set(re.findall(r"#([\w-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda match: match[0] if match[1] in used else "", svg)
    svg = re.sub("#0[1-6]0[1-6]0[1-9]", lambda match: f"var({_VARIABLES[match[0]]})", svg)
    return Markup(svg.strip())


def _mark(axes: Axes, neutral: float, word: str, limit: float, names: Sequence[str]) -> None:
    """Vertical lines at what means nothing and at the limit, and the names of the rows."""
    axes.axvline(neutral, color=_INK, linewidth=1)
    axes.axvline(limit, color=_LIMIT, linewidth=1, linestyle="--")
    for x, text, side, points in ((neutral, word, "right", -3), (limit, "limit", "left", 3)):
        where, beside = ("data", "axes fraction"), (points, 2)
        axes.annotate(
            text, (x, 1), beside, where, "offset points", ha=side, va="bottom", fontsize=8.5, color=_MUTED
        )
    axes.set_yticks(range(len(names)), [_short(name) for name in names])
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)


def _share(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _short(name: str, longest: int = _LONGEST_NAME) -> str:
    name = clean(name)
    return name if len(name) <= longest else name[: longest - 1] + "…"
