"""Who holds one key cannot tell whether there are other secrets: simulated over many hidings."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import ks_2samp

from channels.quiet.trained_like import keys
from keyss.channels import Payload, key_cipher
from keyss.channels.quiet.payloads import Writer
from keyss.channels.quiet.quiet_header import chunk_cipher, parameter_cipher
from keyss.channels.quiet.usable import SALTS
from keyss.core import KeyssWarning

CARRIERS, WIDTH = 3000, 75
IDS = np.random.default_rng(0).integers(0, 256, (CARRIERS, 16), np.uint8)
OWN = keys(0)
HIDINGS = 40
QUARTER = 24_000  # bytes that fit into a quarter of these carriers


def _seen(sizes: Sequence[int]) -> list[float]:
    """What the holder of the first key can count of its own cells, and of all others together."""
    writer = Writer(IDS, WIDTH, os.urandom(32), len(IDS), IDS)
    payloads = [Payload("test", os.urandom(size)) for size in sizes]
    writer.write([([each] * SALTS, payload) for each, payload in zip(OWN, payloads, strict=False)])
    low = np.empty_like(writer.table)
    low[writer.order] = writer.table
    fits, found = key_cipher(OWN[0]).decrypt(IDS, low)
    data_key = found[0].tobytes()
    headers = fits | parameter_cipher(data_key, WIDTH).decrypt(IDS, low)[0]
    own = chunk_cipher(data_key, WIDTH).decrypt(IDS, low)[0]
    places = np.flatnonzero(own)
    return [
        float(headers.sum()),
        float(own.sum()),
        float(places.mean()),
        float(np.diff(places).var()),
        float((own[1:] & own[:-1]).sum()),
        float((headers[1:] & own[:-1]).sum()),
        float(low[~own & ~headers].mean()),
    ]


def _least_chance(alone: list[list[float]], beside: list[list[float]]) -> float:
    """Of two-sample Kolmogorov-Smirnov tests, one for each number that is counted."""
    columns = zip(zip(*alone, strict=True), zip(*beside, strict=True), strict=True)
    return min(float(ks_2samp(first, second).pvalue) for first, second in columns)


@pytest.mark.parametrize(
    ("own", "others"),
    [
        (QUARTER, [QUARTER]),
        (5000, [QUARTER, 9000, 1]),
        (2 * QUARTER, [QUARTER, 100]),
        (5000, [2 * QUARTER]),
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
        beside = [_seen([QUARTER, 30_000, 30_000]) for _ in range(HIDINGS)]
    assert {each.category for each in caught} == {KeyssWarning}
    assert _least_chance(alone, beside) < 1e-10
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _seen([1000] * 5)
