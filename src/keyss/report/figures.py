"""Figures as SVG that is part of the page: its fonts, and colours that follow its light or dark scheme.

matplotlib draws with colours that stand for CSS variables. The same data give the same bytes on every day.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keyss.report.numbers import times
from keyss.report.untrusted import clean

# Each stands for the CSS variable of this name; page.css says what it looks like in light and dark.
_INK, _MUTED, _GRID, _STEGO, _LIMIT, _PAGE = (
    "#010101",
    "#020202",
    "#030303",
    "#040404",
    "#050505",
    "#060609",
)
_LINES = ("#060601", "#060602", "#060603", "#060604", "#060605", "#060606", "#060607", "#060608")
_VARIABLES = {
    _INK: "--ink",
    _MUTED: "--muted",
    _GRID: "--grid",
    _STEGO: "--accent",
    _LIMIT: "--limit",
    _PAGE: "--page",
    **{color: f"--line-{index}" for index, color in enumerate(_LINES, start=1)},
}
_MARKERS = "osD^vPX*"
_LONGEST_NAME = 28
_WIDTH = 4.2  # inches; on a phone's width text is then about as large as it is here


@dataclass(frozen=True)
class Interval:
    """An estimate and the interval about it."""

    name: str
    value: float
    low: float
    high: float
    innocent: bool


@dataclass(frozen=True)
class RocCurve:
    """Shares of renders called suspect: of controls (x), of the published model (y)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True)
class AttackCurve:
    """What an attack costs, from strength to strength."""

    name: str
    points: Sequence[tuple[float, float | None]]  # dB of the cover and of the secret; None: it does not open


def ratio_bars(ratios: Sequence[tuple[str, float]], limit: float, description: str) -> Markup:
    """Ratios to the seed-to-seed variation, all above 0, as bars that start from 1, on a logarithmic axis."""
    names = [_short(name) for name, _ in ratios]
    values = [min(max(value, 1e-3), 1e6) for _, value in ratios]

    def draw(axes: Axes) -> None:
        axes.set_xscale("log")
        low, high = min(0.6, *(0.8 * v for v in values)), max(2.0, *(1.15 * v for v in values))
        axes.set_xlim(low, high)
        rows = range(len(values))
        colors = [_STEGO if value > limit else _LINES[0] for value in values]
        axes.barh(rows, [value - 1 for value in values], left=1, height=0.55, color=colors)
        for row, value in zip(rows, values, strict=True):
            axes.annotate(times(value), (1.02, row), xycoords=("axes fraction", "data"), va="center")
        axes.axvline(1, color=_INK, linewidth=1)
        axes.axvline(limit, color=_LIMIT, linewidth=1, linestyle="--")
        _note(axes, 1, "controls", "right")
        _note(axes, limit, "limit", "left")
        axes.set_yticks(rows, names)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        ticks = [t for t in (0.01, 0.1, 0.5, 1, 2, 5, 10, 20, 50, 100, 1e3, 1e4, 1e5) if low <= t <= high]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
        axes.set_xlabel("distance from the controls, as a multiple of that between them")

    return _figure("ratios", 0.9 + 0.28 * len(values), description, draw)


def intervals(rows: Sequence[Interval], limit: float, description: str) -> Markup:
    """AUCs with their intervals, one below the other."""

    def draw(axes: Axes) -> None:
        for index, row in enumerate(rows):
            color = _MUTED if row.innocent else _STEGO
            axes.plot([row.low, row.high], [index, index], color=color, linewidth=1.5, solid_capstyle="butt")
            axes.plot([row.value], [index], "o", color=color)
        axes.axvline(0.5, color=_INK, linewidth=1)
        axes.axvline(limit, color=_LIMIT, linewidth=1, linestyle="--")
        _note(axes, 0.5, "guessing", "right")
        _note(axes, limit, "limit", "left")
        axes.set_yticks(range(len(rows)), [_short(row.name) for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(min(0.4, *(row.low - 0.02 for row in rows)), 1.02)
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("AUC")

    return _figure("two-sample", 0.9 + 0.22 * len(rows), description, draw)


def histogram(
    name: str,
    edges: Sequence[float],
    stego: Sequence[float],
    controls: Sequence[Sequence[float]],
    description: str,
) -> Markup:
    """Shares of the Gaussians in bins: the published model filled, each control a line."""

    def draw(axes: Axes) -> None:
        axes.stairs(stego, edges, fill=True, color=_STEGO, alpha=0.45, linewidth=0)
        for shares in controls:
            axes.stairs(shares, edges, color=_INK, linewidth=0.9, alpha=0.75)
        axes.set_title(_short(name), loc="left", fontsize=9.5)
        axes.set_ylim(bottom=0)
        axes.grid(visible=False)
        axes.spines["left"].set_visible(False)
        axes.set_yticks([])
        axes.margins(x=0.01)

    return _figure(f"histogram-{name}", 1.75, description, draw, width=3.2)


def roc(curves: Sequence[RocCurve], description: str) -> Markup:
    """Receiver operating characteristics: the share of marked renders found, against false alarms."""

    def draw(axes: Axes) -> None:
        axes.plot([0, 1], [0, 1], color=_INK, linewidth=1)
        axes.annotate("guessing", (0.62, 0.62), (5, -3), textcoords="offset points", va="top", fontsize=8.5)
        for curve, color in zip(curves, (_STEGO, *_LINES), strict=False):
            axes.plot(curve.x, curve.y, color=color, label=_short(curve.name, 40))
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.01)
        axes.set_aspect("equal")
        axes.set_xlabel("renders of plain models called suspect")
        axes.set_ylabel("renders of the published one called suspect", rotation_mode="anchor")
        axes.legend(loc="lower right")

    return _figure("roc", 3.6, description, draw)


def losses(name: str, curves: Sequence[AttackCurve], description: str) -> Markup:
    """What attacks cost the secret (y), against what they cost the cover (x), both in dB.

    Where the secret does not open a hollow mark stands above all others; attacks after which it never does
    are one grey row of them.
    """
    right = max([1.0, *(x for curve in curves for x, _ in curve.points)])
    top = max([1.0, *(y for curve in curves for _, y in curve.points if y is not None)])
    lost = 1.15 * top
    survived = [curve for curve in curves if any(y is not None for _, y in curve.points)]
    fatal = [x for curve in curves if curve not in survived for x, _ in curve.points]

    def draw(axes: Axes) -> None:
        end = min(right, top)
        axes.plot([0, end], [0, end], color=_INK, linewidth=1)
        axes.annotate("equal", (end, end), (4, 0), textcoords="offset points", va="center", color=_MUTED)
        if fatal:
            label = "opens at no strength"
            axes.plot(fatal, [lost] * len(fatal), "o", color=_MUTED, markerfacecolor=_PAGE, label=label)
        for index, curve in enumerate(survived):
            color, marker = _LINES[index % len(_LINES)], _MARKERS[index // len(_LINES) % len(_MARKERS)]
            x, y = [x for x, _ in curve.points], [lost if y is None else y for _, y in curve.points]
            axes.plot(x, y, marker=marker, color=color, linewidth=1.3, label=_short(curve.name))
            hollow = [x for x, y in curve.points if y is None]
            axes.plot(hollow, [lost] * len(hollow), marker, color=color, markerfacecolor=_PAGE)
        if any(y is None for curve in curves for _, y in curve.points):
            _mark_lost(axes, top, lost)
        axes.set_xlabel("cover loses, dB")
        axes.set_ylabel(f"{_short(name)} loses, dB", rotation_mode="anchor")
        axes.figure.legend(loc="outside lower left", ncols=2, columnspacing=1.2, handlelength=1.6)

    rows = math.ceil((len(survived) + bool(fatal)) / 2)
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


def _note(axes: Axes, x: float, text: str, side: str) -> None:
    """A word beside the top of a vertical line."""
    axes.annotate(
        text,
        (x, 1),
        (-3 if side == "right" else 3, 2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha=side,
        va="bottom",
        fontsize=8.5,
        color=_MUTED,
    )


def _short(name: str, longest: int = _LONGEST_NAME) -> str:
    name = clean(name)
    return name if len(name) <= longest else name[: longest - 1] + "…"
