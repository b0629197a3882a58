"""A reproduced table of the paper: `TABLE.json`, and `TABLE.md`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from keyss._version import __version__
from keyss.many.paper.claims import JudgedClaim, Place, judged
from keyss.many.paper.published import Figure
from keyss.many.paper.tables import Table
from keyss.many.tables import markdown_rows


@dataclass(frozen=True, kw_only=True)
class FigureRow:
    """Figures of one run by measure, means over pairs of scenes."""

    label: str
    published: dict[str, float]
    here: dict[str, float | None]  # None: not measured on all pairs


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """The whole table."""

    version: int = 2
    keyss: str = __version__
    table: str
    title: str
    arguments: dict[str, Any]
    pairs: tuple[str, ...]
    rows: tuple[FigureRow, ...]
    claims: tuple[JudgedClaim, ...]
    failures: dict[str, str] = field(default_factory=dict)  # of runs, and why


def laid_out(
    table: Table,
    numbers: Mapping[str, Sequence[Mapping[str, float]]],  # by run, of each pair with a result
    pairs: Sequence[str],
    *,
    covers: Collection[str],  # the paper's, to choose its figures by; without any, means over all
    arguments: dict[str, Any],
    failures: dict[str, str],
) -> Reproduction:
    """Published figures beside those measured, and the verdicts on the claims.

    A figure is missing unless it was measured on all pairs: means over different ones do not compare.
    """

    def here(place: Place) -> float | None:
        run, measure = place
        found = [each[measure] for each in numbers.get(run, ()) if measure in each]
        return fmean(found) if found and len(found) == len(pairs) else None

    rows = [
        FigureRow(
            label=run.label,
            published={name: figure_of(figure, covers) for name, figure in run.figures.items()},
            here={name: here((run.name, name)) for name in run.figures},
        )
        for run in table.runs
    ]
    return Reproduction(
        table=table.name,
        title=table.title,
        arguments=arguments,
        pairs=tuple(pairs),
        rows=tuple(rows),
        claims=tuple(judged(claim, here) for claim in table.claims),
        failures=failures,
    )


def figure_of(figure: Figure, covers: Collection[str] = ()) -> float:
    """A figure as one number: the mean over those of the `covers` that it has, else over all."""
    if not isinstance(figure, Mapping):
        return figure
    return fmean([value for name, value in figure.items() if name in covers] or figure.values())


def cells(found: Reproduction) -> list[list[str]]:
    """Rows of text, the heads first: "published / here". A table of one row is turned."""
    rows = [
        {name: (_number(figure), _number(row.here[name])) for name, figure in row.published.items()}
        for row in found.rows
    ]
    if len(rows) == 1:
        return [[found.rows[0].label, "published", "here"], *([name, *own] for name, own in rows[0].items())]
    names = list(dict.fromkeys(name for row in rows for name in row))
    texts = [[" / ".join(row[name]) if name in row else "" for name in names] for row in rows]
    labels = ["published / here", *(row.label for row in found.rows)]
    return [[label, *line] for label, line in zip(labels, [names, *texts], strict=True)]


def verdicts(found: Reproduction) -> list[str]:
    """A line for each claim and for each run that failed."""
    lines = [f"{each.verdict} ({each.holding} of {each.parts}): {each.text}" for each in found.claims]
    return [*lines, *(f"failed: {name}: {error}" for name, error in found.failures.items())]


def markdown(found: Reproduction) -> str:
    """The table, its verdicts and arguments."""
    lines = [f"# {found.title}", "", *markdown_rows(cells(found)), ""]
    lines += [f"- {line}" for line in verdicts(found)]
    told = ", ".join(f"{name} {value}" for name, value in found.arguments.items() if value is not None)
    lines += ["", f"Means over {len(found.pairs)} pair(s): {', '.join(found.pairs)}. {told}.", ""]
    return "\n".join(lines)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.4f}"
