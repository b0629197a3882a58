"""Who holds one key cannot tell whether there are other secrets: simulated over many hidings."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import ks_2samp

from channels.lsb.trained_like import keys
from keyss.channels import LEAST, Layout, LowBitsCapacity, Parameters, Payload, Shards
from keyss.channels.container import key_secret
from keyss.channels.lsb.low_bits import Writer
from keyss.channels.lsb.low_bits_capacity import codewords_of, key_message, parameter_message
from keyss.core import KeyssWarning

CARRIERS, LAYOUT = 4000, Layout(3)
IDS = np.random.default_rng(0).integers(0, 256, (CARRIERS, 16), np.uint8)
KEYS = [keys(seed) for seed in range(5)]
HIDINGS = 40
CAPACITY = LowBitsCapacity(CARRIERS, CARRIERS, LAYOUT, LEAST)
QUARTER = CAPACITY.for_payloads().shares[0][1]  # bytes that fit into a quarter of these carriers
THIRD = CAPACITY.for_payloads().equal(3)  # bytes that fit into equal shares of three


def _seen(sizes: Sequence[int]) -> list[float]:
    """What the holder of the first key can count of its own rows, and of all others together."""
    payloads = [Payload("test", os.urandom(size)) for size in sizes]
    writer = Writer(CAPACITY, np.ones(CARRIERS, bool), IDS, os.urandom(32))
    low = np.empty((CARRIERS, LAYOUT.width(LEAST)), np.uint8)
    for _, rows, data in writer.write(list(zip(KEYS, payloads, strict=False))):
        low[rows, : data.shape[1]] = data
    message = key_message(key_secret(KEYS[0][0]), low.shape[1])
    data_key = message.read(IDS, low.__getitem__)
    places, contents = message.write(IDS, data_key)
    own_key = (low[places, :16] == contents).all(axis=1)
    message = parameter_message(data_key, low.shape[1])
    packed = message.read(IDS, low.__getitem__)
    places, contents = message.write(IDS, packed)
    own_parameters = (low[places, : contents.shape[1]] == contents).all(axis=1)
    found = Parameters.unpack(packed, data_key)
    own = Shards(data_key, codewords_of(found, LAYOUT), True).decrypt(IDS, low)[0]
    return [
        float(own_key.sum()),
        float(own_parameters.sum()),
        float(own.sum()),
        float(np.flatnonzero(own).mean()),
        float(np.diff(np.flatnonzero(own)).var()),
        float((own[1:] & own[:-1]).sum()),
        float(low[~own].mean()),
    ]


def _least_chance(alone: list[list[float]], beside: list[list[float]]) -> float:
    """Of two-sample Kolmogorov-Smirnov tests, one for each number that is counted."""
    columns = zip(zip(*alone, strict=True), zip(*beside, strict=True), strict=True)
    return min(float(ks_2samp(first, second).pvalue) for first, second in columns)


@pytest.mark.parametrize(
    ("own", "others"),
    [
        (QUARTER, [QUARTER]),
        (2000, [QUARTER, 3000, 1]),
        (2 * QUARTER, [QUARTER, 100]),
        (2000, [2 * QUARTER]),
    ],
    ids=["quarters", "four secrets", "half beside quarters", "quarter beside half"],
)
def test_secrets_lie_as_if_they_were_alone(own: int, others: list[int]) -> None:
    alone = [_seen([own]) for _ in range(HIDINGS)]
    beside = [_seen([own, *others]) for _ in range(HIDINGS)]
    assert _least_chance(alone, beside) > 1e-5


def test_who_is_crowded_is_warned_for_it_can_be_seen() -> None:
    """The control: the numbers do show it where secrets do not fit as each would alone."""
    alone = [_seen([QUARTER]) for _ in range(HIDINGS)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        beside = [_seen([QUARTER, THIRD, THIRD]) for _ in range(HIDINGS)]
    assert {warning.category for warning in caught} == {KeyssWarning}
    assert _least_chance(alone, beside) < 1e-10
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _seen([1000] * 5)
