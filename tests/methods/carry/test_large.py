"""Carrying at the size that people have: 100,000 Gaussians. `benchmarks/carry.py` measures more."""

from __future__ import annotations

import time

import pytest

from channels.low_bits.trained_like import keys, trained_like
from keyss.channels import LowBitsReader
from keyss.core import WrongKeyError
from methods.carry.carried import embed, embed_derived, extract, extract_derived

pytestmark = pytest.mark.slow


def test_100000_in_100000_take_seconds() -> None:
    cover, secret = trained_like(100_000), trained_like(100_000, 1)
    start = time.process_time()  # of all threads; wall-clock time depends on what else runs
    stego = embed(cover, [("key", secret)])
    hidden = time.process_time()
    carried = extract(stego, "key")
    assert len(carried.gaussians) == carried.count == 100_000
    assert hidden - start < 2 * 5  # two cores, five seconds
    assert time.process_time() - hidden < 2 * 5


def test_two_secrets_of_40000_in_100000_and_a_third_key_that_hides_nothing() -> None:
    """Each takes more than a fifth of the carriers, so two of its records share one."""
    cover, own = trained_like(100_000), [keys(seed) for seed in (1, 2, 3)]
    stego = embed_derived(cover, [(each, trained_like(40_000, seed)) for seed, each in enumerate(own[:2])])
    carriers = LowBitsReader.of(stego)
    for each in own[:2]:
        carried = extract_derived(carriers, each[0])
        assert len(carried.gaussians) == 40_000
        assert carried.bits == 264
    with pytest.raises(WrongKeyError):
        extract_derived(carriers, own[2][0])
