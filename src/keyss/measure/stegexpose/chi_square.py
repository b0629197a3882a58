"""Chi Square: do values that differ in the last bit only come equally often, as random bits make them?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

_SAMPLES = 1024  # per block
_LEAST_BLOCKS = 256  # the original program fails below
_FREEDOM = 127  # of the test; there are 128 terms
_AT_ONCE = 4096  # blocks whose histograms are in memory together


def chi_square(image: NDArray[np.uint8]) -> float | None:
    """Mean p-value over the beginnings of [H, W, 3] that are 1024, 2048, ... samples long; in [0, 1].

    Samples go by rows, red green blue. None for images of less than about 87,700 pixels. Not calibrated: a
    smooth histogram alone gives 0.3.
    """
    samples = image.reshape(-1)
    blocks = len(samples) // _SAMPLES - 1
    if blocks < _LEAST_BLOCKS:
        return None
    histogram = np.ones(256, dtype=np.int64)
    total = 0.0
    for start in range(0, blocks, _AT_ONCE):
        count = min(_AT_ONCE, blocks - start)
        part = samples[start * _SAMPLES : (start + count) * _SAMPLES].reshape(count, _SAMPLES)
        bins = part + 256 * np.arange(count)[:, None]
        histograms = histogram + np.bincount(bins.reshape(-1), minlength=256 * count).reshape(
            count, 256
        ).cumsum(0)
        histogram = histograms[-1]
        total += float(_p_values(histograms).sum())
    return total / blocks


def _p_values(histograms: NDArray[np.int64]) -> NDArray[np.float64]:
    """[N] p-values of [N, 256] histograms, none of whose bins is empty."""
    observed = histograms[:, 0::2].astype(np.float64)
    expected = ((histograms[:, 0::2] + histograms[:, 1::2]) // 2).astype(np.float64)
    expected *= (observed.sum(1) / expected.sum(1))[:, None]
    statistic = ((observed - expected) ** 2 / expected).sum(1)
    p_values: NDArray[np.float64] = gammaincc(_FREEDOM / 2, statistic / 2)
    return p_values
