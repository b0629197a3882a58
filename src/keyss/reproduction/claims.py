"""What the paper concludes from a table, and the rule by which that holds for other figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["holds", "holds in part", "does not hold here", "not measured"]
Place = tuple[str, str]  # a run of the table, and a measure of it
Values = Callable[[Place], float | None]

TIE = 0.1  # dB; less is what another seed changes


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
    """A conclusion of the paper's, made of comparisons of means over all pairs of scenes."""

    text: str
    parts: tuple[Part, ...]


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim, and what became of it."""

    text: str
    verdict: Verdict
    parts: int  # that could be measured
    holding: int


def judged(claim: Claim, values: Values) -> JudgedClaim:
    """A claim `holds` where all of its parts hold, and `holds in part` where at least half of them do.

    Parts are comparisons of means over the pairs of scenes that were run. One of which a figure is missing
    does not count; where all are, the claim is `not measured`. "More" in dB means by 0.1 dB at least, as
    another seed changes less; "as much as" means within the loss that the paper found and half a decibel
    (where a part has another limit, the table's definition says it).
    """
    found = [part.holds(values) for part in claim.parts]
    known = [each for each in found if each is not None]
    holding = sum(known)
    verdict: Verdict = "does not hold here"
    if not known:
        verdict = "not measured"
    elif holding == len(known):
        verdict = "holds"
    elif 2 * holding >= len(known):
        verdict = "holds in part"
    return JudgedClaim(text=claim.text, verdict=verdict, parts=len(known), holding=holding)


def above(more: str, others: Sequence[str], measure: str, least: float = TIE) -> tuple[Part, ...]:
    """One run has more of something than each of others, by `least`."""
    return tuple(Part((more, measure), (each, measure), least=least) for each in others)
