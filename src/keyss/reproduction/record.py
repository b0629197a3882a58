"""A table of the paper that was made again: `TABLE.json`, and `TABLE.md`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from keyss._version import __version__
from keyss.reproduction.claims import JudgedClaim, Place, judged
from keyss.reproduction.published import Figure
from keyss.reproduction.tables import Table


@dataclass(frozen=True, kw_only=True)
class MeasuredNumbers:
    """Numbers of one run."""

    version: int = 1
    numbers: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class FigurePair:
    """A published figure and the one measured here, means over pairs of scenes; None: there is none."""

    measure: str
    published: float | None
    here: float | None


@dataclass(frozen=True, kw_only=True)
class FigureRow:
    """Those of one run."""

    label: str
    figures: tuple[FigurePair, ...]


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """The whole table."""

    version: int = 1
    keyss: str = __version__
    table: str
    title: str
    arguments: dict[str, Any]
    pairs: tuple[str, ...]
    rows: tuple[FigureRow, ...]
    claims: tuple[JudgedClaim, ...]
    failures: dict[str, str] = field(default_factory=dict)  # runs that came to nothing, and why


def laid_out(
    table: Table,
    numbers: Mapping[str, Sequence[Mapping[str, float]]],  # by cell, of each pair that came to something
    pairs: Sequence[str],
    *,
    covers: Collection[str],  # of which the paper has figures; none: its means over all are taken
    arguments: dict[str, Any],
    failures: dict[str, str],
) -> Reproduction:
    """Published figures beside those measured, and what the claims come to.

    A figure is missing unless it was measured on all pairs: means over different ones do not compare.
    """

    def here(place: Place) -> float | None:
        cell, measure = place
        found = [each[measure] for each in numbers.get(cell, ()) if measure in each]
        return fmean(found) if found and len(found) == len(pairs) else None

    rows = []
    for row in table.rows:
        figures = [
            FigurePair(measure=measure, published=published(figure, covers), here=here((row.cell, measure)))
            for measure, figure in row.figures.items()
        ]
        rows.append(FigureRow(label=row.label, figures=tuple(figures)))
    return Reproduction(
        table=table.name,
        title=table.title,
        arguments=arguments,
        pairs=tuple(pairs),
        rows=tuple(rows),
        claims=tuple(judged(claim, here) for claim in table.claims),
        failures=failures,
    )


def published(figure: Figure, covers: Collection[str] = ()) -> float:
    """A figure as one number: the mean over those of the `covers` that it knows, else over all."""
    if not isinstance(figure, Mapping):
        return figure
    return fmean([value for name, value in figure.items() if name in covers] or figure.values())


def cells(found: Reproduction) -> list[list[str]]:
    """Rows of text, the heads first: "published / here". A table of one row is turned."""
    names = list(dict.fromkeys(each.measure for row in found.rows for each in row.figures))
    if len(found.rows) == 1:
        (row,) = found.rows
        lines = [[each.measure, _number(each.published), _number(each.here)] for each in row.figures]
        return [[row.label, "published", "here"], *lines]
    rows = []
    for row in found.rows:
        known = {each.measure: f"{_number(each.published)} / {_number(each.here)}" for each in row.figures}
        rows.append([row.label, *(known.get(name, "") for name in names)])
    return [["published / here", *names], *rows]


def markdown(found: Reproduction) -> str:
    """The table, its claims and how it was made."""
    heads, *rows = (" | ".join(line) for line in cells(found))
    rule = " | ".join("---" for _ in heads.split(" | "))
    lines = [f"# {found.title}", "", *(f"| {line} |" for line in (heads, rule, *rows)), ""]
    lines += [f"- **{each.verdict}** ({each.holding} of {each.parts}): {each.text}" for each in found.claims]
    lines += [f"- failed: {name}: {why}" for name, why in found.failures.items()]
    told = ", ".join(f"{name} {value}" for name, value in found.arguments.items() if value is not None)
    lines += ["", f"Means over {len(found.pairs)} pair(s): {', '.join(found.pairs)}. {told}.", ""]
    return "\n".join(lines)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.4f}"
