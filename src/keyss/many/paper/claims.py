"""The paper's conclusions from a table, and the rule by which they hold for other figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["holds", "holds in part", "does not hold here", "not measured"]
Place = tuple[str, str]  # a run of the table, and a measure of it
Values = Callable[[Place], float | None]

TIE = 0.1  # dB; another seed changes less


@dataclass(frozen=True)
class Part:
    """`left - right` lies between `least` and `most`; without `right`, `left` itself."""

    left: Place
    right: Place | None = None
    least: float = -math.inf
    most: float = math.inf

    def holds(self, values: Values) -> bool | None:
        """None where one of the two was not measured."""
        left, right = values(self.left), 0.0 if self.right is None else values(self.right)
        return None if left is None or right is None else self.least <= left - right <= self.most


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper, made of comparisons of means over all pairs of scenes."""

    text: str
    parts: tuple[Part, ...]


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim and its verdict."""

    text: str
    verdict: Verdict
    parts: int  # that could be measured
    holding: int


def judged(claim: Claim, values: Values) -> JudgedClaim:
    """A claim `holds` where all of its parts hold, and `holds in part` where at least half of them do.

    Parts are comparisons of means over the pairs of scenes that were run. A part that lacks a figure does not
    count; without any part, the claim is `not measured`. "More" in dB means by at least 0.1 dB, as another
    seed changes less; "as much as" means within the loss that the paper found and half a decibel, unless
    the table's definition has another limit.
    """
    known = [each for part in claim.parts if (each := part.holds(values)) is not None]
    holding = sum(known)
    verdict: Verdict = "does not hold here"
    if not known:
        verdict = "not measured"
    elif 2 * holding >= len(known):
        verdict = "holds" if holding == len(known) else "holds in part"
    return JudgedClaim(text=claim.text, verdict=verdict, parts=len(known), holding=holding)


def above(more: str, others: Sequence[str], measure: str, least: float = TIE) -> tuple[Part, ...]:
    """One run has at least `least` more of a measure than each of the others."""
    return tuple(Part((more, measure), (each, measure), least=least) for each in others)
