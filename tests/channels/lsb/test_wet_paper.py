"""Wet paper codes: what is read is what was written, and what must stay stays."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings, strategies as st

from keyss.channels.lsb.wet_paper import BLOCK, matrix, read, width_of, write


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), blocks=st.integers(1, 5), share=st.floats(0.1, 1.0))
def test_written_is_read_and_wet_bits_stay(seed: int, blocks: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2, blocks * BLOCK).astype(np.uint8)
    dry = (rng.random(len(bits)) < share).astype(np.uint8)
    rate = 8 * width_of(dry)
    messages = rng.integers(0, 2, (blocks, rate)).astype(np.uint8)
    found = write(bits, dry, messages)
    if found is None:  # by chance, once in a thousand times
        assert dry.reshape(blocks, BLOCK).sum(axis=1).min() < rate + 18
        return
    assert np.array_equal(read(found, rate), messages)
    assert np.array_equal(found[dry == 0], bits[dry == 0])


def test_reading_is_a_product_modulo_two() -> None:
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 2, 3 * BLOCK).astype(np.uint8)
    for block, found in zip(bits.reshape(3, BLOCK), read(bits, 50), strict=True):
        for row, bit in zip(matrix(50), found, strict=True):
            assert int((row & block).sum()) % 2 == bit


def test_too_few_dry_bits() -> None:
    bits, dry = np.zeros(BLOCK, np.uint8), np.zeros(BLOCK, np.uint8)
    messages = np.ones((1, 20), np.uint8)
    dry[:5] = 1
    assert write(bits, dry, messages) is None
    dry[:40] = 1
    assert write(bits, dry, messages) is not None
    assert width_of(dry) == 3
    assert width_of(np.concatenate([dry, 1 - dry])) == 3
    assert width_of(1 - dry) == (1024 - 40 - 10) // 8


def test_most_files_need_one_attempt() -> None:
    rng = np.random.default_rng(1)
    dry = (rng.random(500 * BLOCK) < 0.9).astype(np.uint8)
    rate = 8 * width_of(dry)
    messages = rng.integers(0, 2, (500, rate)).astype(np.uint8)
    assert write(np.zeros_like(dry), dry, messages) is not None
    assert rate > 0.84 * BLOCK


def test_solutions_are_random_where_bits_were() -> None:
    """No dry bit is preferred: each is 1 in half of the files."""
    rng, count = np.random.default_rng(2), 400
    dry = np.tile((rng.random(BLOCK) < 0.9).astype(np.uint8), count)
    before = rng.integers(0, 2, count * BLOCK).astype(np.uint8) * dry
    found = write(before, dry, rng.integers(0, 2, (count, 840)).astype(np.uint8))
    total = found.reshape(count, BLOCK)[:, dry[:BLOCK] == 1].sum(axis=0)
    deviation = (total - count / 2) / (count / 4) ** 0.5
    assert np.abs(deviation).max() < 5.5
    assert 0.8 < deviation.var() < 1.2
