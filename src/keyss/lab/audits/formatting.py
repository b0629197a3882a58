"""Numbers as text; all functions are filters of the report's templates."""

from __future__ import annotations

import math

MINUS = "\N{MINUS SIGN}"
NOTHING = "–"


def number(value: float | None, digits: int = 3) -> str:
    """`value` with a fixed number of decimals; very large numbers as powers of ten."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    plain = f"{value:,.{digits}f}" if abs(value) < 1e7 else f"{value:.{digits}e}"
    return (plain.replace("-", "", 1) if float(plain.replace(",", "")) == 0 else plain).replace("-", MINUS)


def significant(value: float | None) -> str:
    """`value` with three significant digits."""
    if value is None or not math.isfinite(value) or value == 0:
        return number(value, 0)
    return f"{value:#.3g}".replace("-", MINUS)


def difference(value: float | None, digits: int = 2) -> str:
    """`value` with its sign."""
    text = number(value, digits)
    return f"+{text}" if value is not None and value > 0 and text.strip("0.,") else text


def decibel(value: float | None, digits: int = 2) -> str:
    return f"{number(value, digits)} dB"


def times(value: float | None) -> str:
    """A ratio."""
    return NOTHING if value is None else f"{number(value, 2 if abs(value) < 10 else 0)}×"


def numbered(name: str, index: int, count: int) -> str:
    """A name, numbered if `count` is above 1."""
    return f"{name} {index + 1}" if count > 1 else name


def seconds_text(value: float) -> str:
    return f"{number(value / 60, 1)} min" if value >= 100 else f"{significant(value)} s"
