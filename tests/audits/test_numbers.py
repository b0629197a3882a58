"""Numbers as texts."""

from __future__ import annotations

import math

import pytest

from keyss.audits import numbers


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (27.2715, 2, "27.27"),
        (-0.5, 1, "−0.5"),
        (-0.001, 2, "0.00"),
        (12345, 0, "12,345"),
        (1e12, 2, "1.00e+12"),
        (math.inf, 2, "∞"),
        (-math.inf, 2, "−∞"),
        (None, 2, "–"),
        (math.nan, 2, "–"),
    ],
)
def test_number(value: float | None, digits: int, text: str) -> None:
    assert numbers.number(value, digits) == text


def test_a_difference_has_its_sign_unless_it_rounds_to_nothing() -> None:
    texts = [numbers.difference(value) for value in (0.42, -0.42, 0.0, 0.001, -0.001, None)]
    assert texts == ["+0.42", "−0.42", "0.00", "0.00", "0.00", "–"]


def test_units() -> None:
    assert [numbers.bytes_text(v) for v in (999, 1500, 4961530)] == ["999 B", "1.5 kB", "4.96 MB"]
    assert [numbers.seconds_text(v) for v in (0.0214, 3.14, 612, 9000)] == [
        "0.0214 s",
        "3.1 s",
        "10.2 min",
        "2.5 h",
    ]
    assert [numbers.times(v) for v in (1.124, 84.2, None)] == ["1.12×", "84×", "–"]
    assert numbers.significant(0.004) == "0.00400"
