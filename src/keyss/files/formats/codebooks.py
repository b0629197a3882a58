"""Codebooks of numbers and palettes of vectors.

Numbers are quantised by Lloyd's method, which takes milliseconds in one dimension. Vectors are grouped by a
tree that splits the worst group first: k-means with tens of thousands of clusters, which other writers run,
takes minutes without a GPU and gains less than rounding to 8 bits loses.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Bytes, Floats, Shorts

SIZE = 256  # numbers of a codebook
_ROUNDS = 50
_BINS = 1024  # with equally many values each, to estimate the density
_MIN_WIDTH = 1e-6  # of a bin, relative to the range, since values may be equal
_AXES = 12  # principal axes by which groups are split
_SAMPLE = 50_000  # vectors from which the axes are computed


def codebook_of(values: Floats) -> Floats:
    """[256] ascending numbers that approximate `values` of any shape.

    Squared errors are weighted by the inverse square root of the density: rare values often belong to the few
    Gaussians that cover most of the image. On six models, this gains 0 to 8 dB over equal weights.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    distinct = np.unique(ordered)
    if len(distinct) <= SIZE:
        return np.pad(distinct, (0, SIZE - len(distinct)), mode="edge").astype(np.float32)
    at = np.unique(np.linspace(0, len(ordered) - 1, _BINS + 1).astype(int))
    width = np.maximum(np.diff(ordered[at]), _MIN_WIDTH * (distinct[-1] - distinct[0]))
    density = np.diff(at) / width
    # The optimal density of the numbers is the cube root of the weighted density (Panter and Dite 1951).
    share = np.concatenate([[0.0], np.cumsum(width * density ** (1 / 6))])
    numbers = np.interp((np.arange(SIZE) + 0.5) / SIZE * share[-1], share, ordered[at])
    weight = np.repeat(density**-0.5, np.diff(np.append(at[:-1], len(ordered))))
    weights = np.concatenate([[0.0], np.cumsum(weight)])
    sums = np.concatenate([[0.0], np.cumsum(weight * ordered)])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(ordered, (numbers[1:] + numbers[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        mass = np.diff(weights[ends])
        moved = np.where(mass > 0, np.diff(sums[ends]) / np.where(mass > 0, mass, 1), numbers)
        if np.array_equal(moved, numbers):
            break
        numbers = np.sort(moved)
    codebook: Floats = numbers.astype(np.float32)
    return codebook


def nearest(codebook: Floats, values: Floats) -> Bytes:
    """Indices of the nearest numbers of an ascending codebook, in the shape of `values`."""
    middles = (codebook[1:].astype(np.float64) + codebook[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def palette_of(vectors: Floats, size: int) -> tuple[Floats, Shorts]:
    """A palette [P, D] of at most `size` (up to 65,536) vectors for `vectors` [N, D], and labels [N]."""
    from keyss.files.formats.grouping import groups  # numba takes a second to import

    with np.errstate(over="ignore"):
        centred = np.nan_to_num(vectors - vectors.mean(axis=0, dtype=np.float64).astype(np.float32))
    sample = centred[:: max(1, len(centred) // _SAMPLE)].astype(np.float64)
    _, axes = np.linalg.eigh(sample.T @ sample)
    shadow = np.ascontiguousarray(centred.astype(np.float64) @ axes[:, : -_AXES - 1 : -1])
    order, starts = groups(shadow, size)
    count = np.diff(np.append(starts, len(vectors)))
    palette = np.add.reduceat(vectors[order], starts, axis=0, dtype=np.float64) / count[:, None]
    labels = np.empty(len(vectors), np.uint16)
    labels[order] = np.repeat(np.arange(len(starts)), count)
    return palette.astype(np.float32), labels
