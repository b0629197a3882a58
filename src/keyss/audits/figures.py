"""The figures of a report, as SVG inside the page; None where there is nothing to plot.

They use the page's fonts, and colours that follow its light or dark scheme: matplotlib plots with placeholder
colours, which are replaced by CSS variables. The same data always give the same bytes.
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

from keyss.audits.numbers import numbered
from keyss.audits.untrusted import clean
from keyss.measure.robustness.survival import UNCHANGED, ChangeResult

# Placeholders for the CSS variables in _VARIABLES; page.css defines them for light and dark.
_INK, _MUTED, _GRID = "#010101", "#020202", "#030303"
_STEGO, _PAGE = "#040404", "#060609"
_LINES = tuple(f"#06060{index}" for index in range(1, 9))
_VARIABLES = {color: f"--line-{index}" for index, color in enumerate(_LINES, start=1)}
_VARIABLES |= {_INK: "--ink", _MUTED: "--muted", _GRID: "--grid", _PAGE: "--page"}
_VARIABLES |= {_STEGO: "--accent"}
_MARKERS = "osD^vPX*"
_MAX_NAME = 28
_WIDTH = 4.2  # inches: on a phone, text is about as large as in the page
_MAX_PLOTTED = 100

# dB that the cover and the secret lose; None: the secret does not open.
Curve = Sequence[tuple[float, float | None]]


def losses(rows: Sequence[ChangeResult]) -> list[Markup]:
    """For each secret, what attacks cost it (y) against what they cost the cover (x), in dB.

    A hollow mark above all others means that the secret does not open; attacks after which it never opens
    share one grey row.
    """
    count = max((len(row.secrets) for row in rows), default=0)
    figures = []
    for index in range(min(count, _MAX_PLOTTED)):
        if curves := _curves(rows, index):
            figures.append(_losses(numbered("secret", index, count), curves))
    return figures


def _curves(rows: Sequence[ChangeResult], index: int) -> dict[str, Curve]:
    """A curve for each attack, through its strengths."""
    points: dict[str, list[tuple[float, float | None]]] = {}
    for row in rows:
        if row.attack != UNCHANGED and row.cover is not None and index < len(row.secrets):
            secret = row.secrets[index]
            points.setdefault(row.attack, []).append((row.cover.loss, secret.loss if secret.opens else None))
    return dict(list(points.items())[:_MAX_PLOTTED])


def _losses(name: str, curves: Mapping[str, Curve]) -> Markup:
    right = max([1.0, *(x for points in curves.values() for x, _ in points)])
    top = max([1.0, *(y for points in curves.values() for _, y in points if y is not None)])
    lost = 1.15 * top
    survived = {attack: points for attack, points in curves.items() if any(y is not None for _, y in points)}
    fatal = [x for attack, points in curves.items() if attack not in survived for x, _ in points]

    def plot(axes: Axes) -> None:
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
    return _figure(f"losses-{name}", 3.1 + 0.19 * rows, description, plot)


def _mark_lost(axes: Axes, top: float, lost: float) -> None:
    """A line above the axis, which ends at `top`, for secrets that do not open."""
    bottom, _ = axes.get_ylim()
    axes.set_yticks([tick for tick in axes.get_yticks() if bottom <= tick <= top])
    axes.set_ylim(bottom, 1.1 * lost)
    axes.axhline(lost, color=_GRID, linewidth=0.6, zorder=0)
    where = ("axes fraction", "data")
    axes.annotate("does not open", (1, 1.02 * lost), xycoords=where, ha="right", va="bottom", color=_MUTED)


def _figure(name: str, height: float, description: str, plot: Callable[[Axes], None]) -> Markup:
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # glyphs that its font lacks: the browser has them
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_style())
        matplotlib.rcParams["svg.hashsalt"] = name
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        plot(figure.add_subplot())
        written = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(written, format="svg", metadata=nothing)
    figure_of = Markup('<div class="plot" role="img" aria-label="{}">{}</div>')
    return figure_of.format(clean(description), _for_a_page(written.getvalue()))


@cache
def _style() -> matplotlib.RcParams:
    with as_file(files("keyss.audits") / "assets" / "figures.mplstyle") as path:
        return matplotlib.rc_params_from_file(path, use_default_template=False)


def _for_a_page(svg: str) -> Markup:
    """matplotlib's SVG without the parts of a standalone file, and with colours as CSS variables."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' (?:width|height)="[\d.]+pt"', "", svg, count=2)
    svg = re.sub(r"\s*<(metadata|style)\b.*?</\1>", "", svg, flags=re.DOTALL)
    used = set(re.findall(r"#([\w-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda match: match[0] if match[1] in used else "", svg)
    svg = re.sub("#0[1-6]0[1-6]0[1-9]", lambda match: f"var({_VARIABLES[match[0]]})", svg)
    return Markup(svg.strip())


def _short(name: str, longest: int = _MAX_NAME) -> str:
    name = clean(name)
    return name if len(name) <= longest else name[: longest - 1] + "…"
