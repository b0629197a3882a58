"""The bits of Splats in Splats: what comes back, and what the cover pays for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from keyss.methods.peers.watergs import COVER_BITS, graded_bits, ranges_of, read_bits, write_bits
from tiny_scenes import random_gaussians

CIPHER = bytes(range(32))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_come_back_rounded_by_half_a_step(degree: int) -> None:
    cover, secret = (random_gaussians(500, seed, degree).sh for seed in (0, 1))
    ranges = ranges_of(secret)
    sizes = graded_bits(degree)
    found = read_bits(write_bits(cover, secret, ranges, CIPHER), ranges, CIPHER)
    for index in range(cover.shape[1]):
        each = int(index**0.5)
        most = float(ranges[each])
        error = (found[:, index] - secret[:, index].clamp(-most, most)).abs().max()
        assert float(error) <= 1.01 * most / (2 ** sizes[each] - 1)
    # Importance: constant coefficients are the finest.
    assert list(sizes) == sorted(sizes, reverse=True)
    assert sum((2 * d + 1) * (COVER_BITS[d] - sizes[d]) for d in range(degree + 1)) >= 0


def test_the_cover_keeps_its_high_bits_and_the_low_ones_say_nothing() -> None:
    cover, secret = (random_gaussians(3000, seed, 3).sh for seed in (0, 1))
    stego = write_bits(cover, secret, ranges_of(secret), CIPHER)
    for index in range(16):
        bits = COVER_BITS[int(index**0.5)]
        high = [values[:, index].contiguous().numpy().view(np.uint32) >> bits for values in (cover, stego)]
        assert (high[0] == high[1]).all()
        low = stego[:, index].contiguous().numpy().view(np.uint32) & ((1 << bits) - 1)
        for bit in range(bits):
            assert abs(((low >> bit) & 1).mean() - 0.5) < 0.03  # 5 standard deviations
    change = ((stego - cover).abs() / cover.abs().clamp_min(1e-12)).flatten(1).amax()
    assert float(change) < 2.0 ** (max(COVER_BITS) - 23)


def test_another_cipher_gives_nothing() -> None:
    cover, secret = (random_gaussians(500, seed, 3).sh for seed in (0, 1))
    ranges = ranges_of(secret)
    wrong = read_bits(write_bits(cover, secret, ranges, CIPHER), ranges, bytes(32))
    for index in (0, 5, 15):
        correlation = np.corrcoef(wrong[:, index].flatten().numpy(), secret[:, index].flatten().numpy())[0, 1]
        assert abs(correlation) < 0.12


def test_the_bits_that_matter_most_are_the_last_to_be_lost() -> None:
    """Written into single precision and read with 6 bits less: noise comes in where it costs least."""
    cover, secret = (random_gaussians(500, seed, 3).sh for seed in (0, 1))
    ranges = ranges_of(secret)
    stego = write_bits(cover, secret, ranges, CIPHER)
    words = stego.numpy().view(np.uint32).copy()
    words[:, 9:] ^= np.uint32(1 << 13)  # the highest bit that is used of degree 3
    found = read_bits(torch.from_numpy(words.view(np.float32)), ranges, CIPHER)
    error = (found - secret.clamp(-float(ranges.max()), float(ranges.max()))).abs()
    assert float(error[:, 0].max()) < 0.01
