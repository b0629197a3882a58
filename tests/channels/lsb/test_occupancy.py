"""Who holds one key cannot tell whether there are other secrets: simulated over many hidings."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import pytest
from scipy.stats import ks_2samp

from channels.lsb.holder import seen_by_holder
from channels.lsb.trained_like import trained_like
from keyss.channels import LEAST, LOW_BITS, LowBitsCover, Payload
from keyss.core import KeyssWarning

HIDINGS = 40
Size = int | Literal["quarter", "half"]  # bytes, or as many as fit into so many of the carriers


@cache
def _prepared() -> LowBitsCover:
    prepared = LOW_BITS.prepare(trained_like(4000))
    return replace(prepared, carriers=replace(prepared.carriers, depth=LEAST))


def _seen(sizes: Sequence[Size]) -> list[float]:
    """What the holder of the first key can count."""
    prepared = _prepared()
    shares = dict(zip(("quarter", "half"), prepared.capacity.shares, strict=False))
    payloads = [
        (str(index), Payload("test", os.urandom(size if isinstance(size, int) else shares[size][1])))
        for index, size in enumerate(sizes)
    ]
    return list(seen_by_holder(prepared.embed(payloads), "0").values())


def _least_chance(alone: list[list[float]], beside: list[list[float]]) -> float:
    """Of two-sample Kolmogorov-Smirnov tests, one for each number that is counted."""
    columns = zip(zip(*alone, strict=True), zip(*beside, strict=True), strict=True)
    return min(float(ks_2samp(first, second).pvalue) for first, second in columns)


@pytest.mark.parametrize(
    ("own", "others"),
    [("quarter", ["quarter"]), (2000, ["quarter", 3000, 1]), ("half", ["quarter", 100]), (2000, ["half"])],
    ids=["quarters", "four secrets", "half beside quarters", "quarter beside half"],
)
def test_secrets_lie_as_if_they_were_alone(own: Size, others: list[Size]) -> None:
    alone = [_seen([own]) for _ in range(HIDINGS)]
    beside = [_seen([own, *others]) for _ in range(HIDINGS)]
    assert _least_chance(alone, beside) > 1e-8  # of 40 tests in all: one false alarm in two million runs


def test_who_is_crowded_is_warned_for_it_can_be_seen() -> None:
    """The control: the numbers do show it where secrets do not fit as each would alone."""
    alone = [_seen(["quarter"]) for _ in range(HIDINGS)]
    third = _prepared().capacity.equal(3)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        beside = [_seen(["quarter", third, third]) for _ in range(HIDINGS)]
    assert {warning.category for warning in caught} == {KeyssWarning}
    assert _least_chance(alone, beside) < 1e-10
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _seen([1000] * 5)
