"""Tables of the KeySS paper: runs, published figures and claims (`paper.toml`), and measured figures."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import msgspec

from keyss._version import __version__

Group = tuple[str, ...]  # names of a cover and of its secrets
Figure = float | tuple[float, ...]  # one number, or one for each published group
Measured = Mapping[str, Mapping[str, float | None]]  # value by run and measure
Verdict = Literal["holds", "holds in part", "does not hold here", "not measured"]

_PART = re.compile(
    r"(?P<run>.+?): (?P<measure>.+?)( - (?P<other>.+?): (?P<other_measure>.+?))? "
    r"(?P<sign>[<>])= (?P<limit>[\d.]+)"
)


class Run(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A hiding with the paper's settings, except for `changes` of the method's options."""

    figures: dict[str, Figure] = {}  # published, by measure
    method: str = "keyss"
    changes: dict[str, Any] = {}
    secrets: int = 1


class Claim(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A conclusion of the paper: comparisons of means over all pairs of scenes."""

    text: str
    parts: tuple[str, ...]


class Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the paper."""

    title: str
    runs: dict[str, Run]
    claims: tuple[Claim, ...]
    measures: tuple[str, ...] = ()  # beyond those of every hiding

    @property
    def secrets(self) -> int:
        """Number of secrets in a group of scenes."""
        return max(run.secrets for run in self.runs.values())

    @property
    def published(self) -> list[str]:
        """All measures with published figures."""
        return list(dict.fromkeys(measure for run in self.runs.values() for measure in run.figures))

    @property
    def groups(self) -> tuple[Group, ...]:
        """The published groups of scenes."""
        return PAPER.pairs if self.secrets == 1 else PAPER.triples


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of `paper.toml`."""

    pairs: tuple[Group, ...]
    triples: tuple[Group, ...]
    tables: dict[str, Table]


PAPER = msgspec.toml.decode(Path(__file__).with_name("paper.toml").read_bytes(), type=Paper)


@dataclass(frozen=True, kw_only=True)
class FigureRow:
    """Figures of one run by measure, means over pairs of scenes."""

    label: str
    published: dict[str, float]
    here: dict[str, float | None]  # None: not measured on all pairs


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim and its verdict."""

    text: str
    verdict: Verdict
    parts: int  # parts that could be measured
    holding: int


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """A reproduced table: `TABLE.json`."""

    version: int = 3
    keyss: str = __version__
    table: str
    title: str
    arguments: dict[str, Any]
    pairs: tuple[str, ...]
    rows: tuple[FigureRow, ...]
    claims: tuple[JudgedClaim, ...]
    failures: dict[str, str] = field(default_factory=dict)  # reasons by run


def figure_rows(
    table: Table,
    numbers: Mapping[str, Sequence[Mapping[str, float]]],  # by run, for each group with a result
    count: int,  # of groups
    covers: Collection[str] = (),
) -> tuple[FigureRow, ...]:
    """Published figures beside measured ones, a row for each run.

    A figure must be measured on all groups, because means over different groups are not comparable.
    `covers`: covers of the published groups that were run; if empty, published figures are means over all.
    """
    rows = []
    for name, run in table.runs.items():
        here: dict[str, float | None] = {}
        for measure in run.figures or table.published:
            values = [each[measure] for each in numbers.get(name, ()) if measure in each]
            here[measure] = fmean(values) if values and len(values) == count else None
        published = {measure: mean_figure(table, figure, covers) for measure, figure in run.figures.items()}
        rows.append(FigureRow(label=name, published=published, here=here))
    return tuple(rows)


def mean_figure(table: Table, figure: Figure, covers: Collection[str] = ()) -> float:
    """The mean of a published figure over its `covers`, or over all groups if it has none of them."""
    if isinstance(figure, float):
        return figure
    by_cover = zip((cover for cover, *_ in table.groups), figure, strict=True)
    return fmean([value for cover, value in by_cover if cover in covers] or figure)


def judge_claim(claim: Claim, figures: Measured) -> JudgedClaim:
    """Judge a claim: it `holds` if all of its parts hold, and `holds in part` if at least half of them do.

    Parts without figures do not count; without any part, the claim is `not measured`.
    """
    parts = [held for part in claim.parts for held in _judge_part(part, figures) if held is not None]
    holding = sum(parts)
    verdict: Verdict = "does not hold here"
    if not parts:
        verdict = "not measured"
    elif 2 * holding >= len(parts):
        verdict = "holds" if holding == len(parts) else "holds in part"
    return JudgedClaim(text=claim.text, verdict=verdict, parts=len(parts), holding=holding)


def _judge_part(part: str, figures: Measured) -> Iterator[bool | None]:
    """True if the part holds, for each run that it compares with; None without a figure."""
    match = _PART.fullmatch(part)
    assert match is not None, part
    run, limit = match["run"], float(match["limit"])
    others = [name for name in figures if name != run] if match["other"] == "*" else [match["other"]]
    for other in others:
        left = figures[run][match["measure"]]
        right = 0.0 if other is None else figures[other][match["other_measure"]]
        if left is None or right is None:
            yield None
        else:
            yield left - right >= limit if match["sign"] == ">" else left - right <= limit


def reproduction_rows(reproduction: Reproduction) -> list[list[str]]:
    """Rows of text, heads first: "published / here". Tables with few runs are transposed."""
    measures = list(dict.fromkeys(measure for row in reproduction.rows for measure in row.here))
    table = [["published / here", *measures]]
    for row in reproduction.rows:
        texts = [
            f"{_number(row.published.get(measure))} / {_number(row.here[measure])}"
            if measure in row.here
            else ""
            for measure in measures
        ]
        table.append([row.label, *texts])
    if len(measures) <= 2 * len(reproduction.rows):
        return table
    return [list(column) for column in zip(*table, strict=True)]


def reproduction_notes(reproduction: Reproduction) -> list[str]:
    """A line per claim and per failed run."""
    lines = [f"{each.verdict} ({each.holding} of {each.parts}): {each.text}" for each in reproduction.claims]
    return [*lines, *(f"failed: {name}: {error}" for name, error in reproduction.failures.items())]


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.4f}"
