"""Who holds one key cannot tell whether there are other secrets: simulated over many hidings."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import ks_2samp

from channels.quiet.trained_like import keys
from keyss.channels import CellCipher, Content, LowBitsCapacity, Payload, RecordRequest, Records, key_cipher
from keyss.channels.quiet.contents import Writer
from keyss.channels.quiet.layout import parameter_cipher, unpack
from keyss.channels.quiet.usable import SALTS
from keyss.core import KeyssWarning

CARRIERS, WIDTH = 3000, 75
CAPACITY = LowBitsCapacity(CARRIERS, WIDTH)
NAMES = np.random.default_rng(0).integers(0, 256, (CARRIERS, 16), np.uint8)
OWN = keys(0)
HIDINGS = 40


def _records(counts: Sequence[int]) -> list[Content]:
    requests = [RecordRequest(count, 33, 168) for count in counts]
    plans = CAPACITY.plan_records(requests)
    random = np.random.default_rng(0)
    return [
        Records(
            "test",
            bytes(168),
            random.integers(0, 256, (count, plan.record_bytes), np.uint8),
            plan,
            np.arange(plan.copies),
        )
        for count, plan in zip(counts, plans, strict=True)
    ]


def _payloads(sizes: Sequence[int]) -> list[Content]:
    return [Payload("test", os.urandom(size)) for size in sizes]


def _seen(contents: Sequence[Content]) -> list[float]:
    """What the holder of the first key can count of its own cells, and of all others together."""
    writer = Writer(NAMES, WIDTH, os.urandom(32), len(NAMES), NAMES)
    keyed = [([each] * SALTS, content) for each, content in zip([OWN[0], *OWN[1:]], contents, strict=False)]
    writer.write(keyed)
    low = np.empty_like(writer.table)
    low[writer.order] = writer.table
    fits, found = key_cipher(OWN[0]).decrypt(NAMES, low)
    data_key = found[0].tobytes()
    parts, packed = parameter_cipher(data_key, WIDTH).decrypt(NAMES, low)
    headers, parameters = fits | parts, unpack(packed)
    both = [CellCipher(data_key, label, parameters.record_bytes) for label in ("record", "copy")]
    step = WIDTH // parameters.cells
    own = np.stack(
        [
            np.any([each.decrypt(NAMES, low[:, slot * step :], slot)[0] for each in both], axis=0)
            for slot in range(parameters.cells)
        ],
        axis=1,
    )
    carriers = own.any(axis=1)
    places = np.flatnonzero(carriers)
    return [
        float(headers.sum()),
        float(own.sum()),
        float(carriers.sum()),
        float(own.all(axis=1).sum()),
        float(own[:, 0].sum()),
        float(places.mean()),
        float(np.diff(places).var()),
        float((carriers[1:] & carriers[:-1]).sum()),
        float((headers[1:] & carriers[:-1]).sum()),
        float(low[~carriers & ~headers].mean()),
    ]


def _least_chance(alone: list[list[float]], beside: list[list[float]]) -> float:
    """Of two-sample Kolmogorov-Smirnov tests, one for each number that is counted."""
    columns = zip(zip(*alone, strict=True), zip(*beside, strict=True), strict=True)
    return min(float(ks_2samp(first, second).pvalue) for first, second in columns)


@pytest.mark.parametrize(
    ("own", "others"),
    [(700, [600, 600, 600]), (700, [300]), (400, [420, 420]), (1500, [600, 700])],
    ids=["halves beside halves", "halves beside whole", "whole beside whole", "large beside halves"],
)
def test_records_lie_as_if_they_were_alone(own: int, others: list[int]) -> None:
    alone = [_seen(_records([own])) for _ in range(HIDINGS)]
    beside = [_seen(_records([own, *others])) for _ in range(HIDINGS)]
    assert _least_chance(alone, beside) > 1e-5


def test_payloads_lie_as_if_they_were_alone() -> None:
    alone = [_seen(_payloads([5000])) for _ in range(HIDINGS)]
    for number in (1, 3):
        beside = [_seen(_payloads([5000, *[9000] * number])) for _ in range(HIDINGS)]
        assert _least_chance(alone, beside) > 1e-5, number


def test_who_is_crowded_is_warned_for_it_can_be_seen() -> None:
    """The control: the numbers do show it where secrets do not fit as each would alone."""
    alone = [_seen(_records([900])) for _ in range(HIDINGS)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        beside = [_seen(_records([900, 3000])) for _ in range(HIDINGS)]
    assert {each.category for each in caught} == {KeyssWarning}
    assert _least_chance(alone, beside) < 1e-10
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _seen(_payloads([1000] * 5))
