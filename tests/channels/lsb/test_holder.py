"""The holder of one key, who tries all shards, sees the same whether there are other secrets or not."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import pytest

from channels.lsb.holder import seen_by_holder
from channels.lsb.trained_like import trained_like
from keyss.channels import LOW_BITS, Payload
from keyss.core import KeyssWarning

COVER = 9000
DRAWS = 3


def _seen(own: float, others: Sequence[float], draw: int) -> dict[str, float]:
    """What the holder of the first key sees; sizes in quarters of the carriers at the least depth."""
    prepared = LOW_BITS.prepare(trained_like(COVER, seed=draw))
    quarter = prepared.capacity.shares[0][1]
    sizes = [int(count * quarter) for count in (own, *others)]
    payloads = [(str(index), Payload("test", os.urandom(size))) for index, size in enumerate(sizes)]
    return seen_by_holder(prepared.embed(payloads), "0")


@pytest.mark.parametrize("others", [[1], [1.9, 1]])
def test_what_the_holder_counts_does_not_depend_on_others(others: list[float]) -> None:
    pairs = [(_seen(1, [], draw), _seen(1, others, draw)) for draw in range(DRAWS)]
    for name in pairs[0][0]:
        alone, beside = (np.array([pair[side].get(name, np.nan) for pair in pairs]) for side in (0, 1))
        spread = max(float(alone.std(ddof=1)), float(beside.std(ddof=1)), 0.01 * abs(float(alone.mean())))
        assert abs(alone.mean() - beside.mean()) <= 5 * spread, name


def test_it_would_be_seen() -> None:
    """The control: where secrets do not fit beside each other as each would alone, the holder sees it."""
    alone = _seen(1, [], 0)
    with pytest.warns(KeyssWarning, match="can notice"):
        beside = _seen(1, [2.5, 2.5], 0)
    assert beside["shards that there were"] > 1.1 * alone["shards that there were"]
