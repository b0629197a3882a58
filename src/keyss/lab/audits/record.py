"""The record of an audit, `audit.json`: a section with verdicts, tables and numbers for each part.

*fine*: within the limit. *visible*: without the key it may be visible that something is hidden, or what.
*missed*: nothing is visible, but the quality is too low. *inconclusive*: controls differ as much from each
other, so that the measure says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from keyss._version import __version__
from keyss.lab.auc import Auc

Word = Literal["fine", "visible", "missed", "inconclusive"]


@dataclass(frozen=True)
class Verdict:
    """One measure against its limit."""

    measure: str
    value: str
    beside: str  # the baseline or control
    limit: str
    word: Word


@dataclass(frozen=True)
class Table:
    """A table of text."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Section:
    """The result of one part of an audit."""

    verdicts: list[Verdict] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: dict[str, str] = field(default_factory=dict)  # file names by caption
    numbers: dict[str, Any]  # everything measured, as JSON


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of an audit."""

    version: int = 6
    keyss: str = __version__
    seconds: float = 0.0
    method: str
    cover: str  # a scene folder, or a model without photos; `secrets` too
    secrets: tuple[str, ...]
    width: int | None  # pixels, if photos were shrunk
    gaussians: int  # Gaussians of the stego model
    controls: tuple[int, ...]  # seeds of the plain models of the cover to compare with
    sections: dict[str, Section] = field(default_factory=dict)  # by part

    @property
    def verdicts(self) -> list[Verdict]:
        """The verdicts of all sections."""
        return [verdict for section in self.sections.values() for verdict in section.verdicts]

    @property
    def unjudged(self) -> list[Table]:
        """The tables of sections without verdicts."""
        return [table for part in self.sections.values() if not part.verdicts for table in part.tables]


def headline(verdicts: Sequence[Verdict]) -> str:
    """The verdicts in one or two sentences."""
    if not verdicts:
        return "No part that was measured has a limit."
    fine = sum(verdict.word == "fine" for verdict in verdicts)
    sentences = [f"Fine: {fine} of {len(verdicts)} measures."]
    for word in ("visible", "missed", "inconclusive"):
        if names := [verdict.measure for verdict in verdicts if verdict.word == word]:
            sentences.append(f"{word.capitalize()}: {', '.join(names)}.")
    return " ".join(sentences)


def text_of(value: float | None, spec: str) -> str:
    """`value` in a format such as ".2f"; a dash for None."""
    return "–" if value is None else format(value, spec)


def auc_text(auc: Auc) -> str:
    """An AUC with its interval: 0.54 (0.43 to 0.65)."""
    return f"{auc.auc:.2f} ({auc.low:.2f} to {auc.high:.2f})"
