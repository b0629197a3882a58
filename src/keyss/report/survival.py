"""What changes of the published file cost, with the draws of a random one taken together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from keyss.report.reading import Part

UNCHANGED = "none"  # the row of the file as it is
_MOST_ROWS = 1000
_MOST_SECRETS = 100


@dataclass(frozen=True)
class Fate:
    """What a change did to the cover or to a secret; means over draws, None where nothing is known."""

    psnr: float | None  # dB
    loss: float | None  # dB
    opens: bool  # in every draw
    error: str  # why not


@dataclass(frozen=True)
class Survival:
    """One attack at one strength."""

    attack: str
    strength: float | None
    unit: str
    sentence: str
    skipped: str  # why it was left out, if it was
    draws: int
    cover: Fate
    secrets: list[Fate]


def survivals(audit: Part) -> list[Survival]:
    """The rows of an audit, those that differ in nothing but what was drawn as one. Raises InputError."""
    groups: dict[tuple[str, float | None], list[Part]] = {}
    for row in audit.parts("robustness", _MOST_ROWS):
        groups.setdefault((row.text("attack"), row.number("strength")), []).append(row)
    return [_survival(attack, strength, rows) for (attack, strength), rows in groups.items()]


def _survival(attack: str, strength: float | None, rows: Sequence[Part]) -> Survival:
    secrets = [row.parts("secrets", _MOST_SECRETS) for row in rows]
    return Survival(
        attack,
        strength,
        rows[0].text("unit"),
        rows[0].text("sentence"),
        rows[0].text("skipped"),
        len(rows),
        _fate([row.part("cover") for row in rows]),
        [_fate(each) for each in zip(*secrets, strict=False)],
    )


def _fate(draws: Sequence[Part]) -> Fate:
    return Fate(
        _mean([draw.number("psnr") for draw in draws]),
        _mean([draw.number("loss") for draw in draws]),
        all(draw.flag("opens") is not False for draw in draws),
        next((error for draw in draws if (error := draw.text("error"))), ""),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
