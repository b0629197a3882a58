"""Loops over the bits of whole models, which NumPy would take dozens of passes for.

Kernels take rows of words [N, C] and write one result for each row.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import kernel

_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: the high bits of multiples are scattered
_MAGNITUDE = np.uint32(0x7FFFFFFF)


@kernel
def hash_rows(rows, found):
    """`found` [N]: see `keyss.channels.mixing.row_hashes`."""
    for i in range(len(rows)):
        state = np.uint64(0)
        for j in range(rows.shape[1]):
            state = (state ^ np.uint64(rows[i, j])) * _ODD
            state ^= state >> np.uint64(29)
        found[i] = state


@kernel
def fill_buckets(words, shift, counts):
    """How many of `words` [N, C] are in each of the buckets `counts` [2^(64 - shift)], at most 255."""
    for i in range(len(words)):
        for j in range(words.shape[1]):
            at = np.uint64(words[i, j]) * _ODD >> np.uint64(shift)
            counts[at] += counts[at] < 255


@kernel
def find_full(words, shift, counts, times, found):
    """`found` [N, C]: whether the bucket of each of `words` [N, C] has at least `times` words."""
    for i in range(len(words)):
        for j in range(words.shape[1]):
            found[i, j] = counts[np.uint64(words[i, j]) * _ODD >> np.uint64(shift)] >= times


@kernel
def find_near(words, shifts, first, step, found):
    """Set `found` [N] where two of `step` words next to each other agree but for their low bits, or nearly.

    `words` [N, C], from column `first` on in groups of `step`; `shifts` [C]: their low bits.
    """
    for i in range(len(words)):
        for group in range(first, words.shape[1] - step + 1, step):
            for a in range(group, group + step):
                for b in range(a + 1, group + step):
                    one = np.int64((words[i, a] & _MAGNITUDE) >> shifts[a])
                    other = np.int64((words[i, b] & _MAGNITUDE) >> shifts[b])
                    if abs(one - other) <= 1:
                        found[i] = True


@kernel
def find_equal(words, shifts, first, most, found):
    """Set `found` [N] where `most` pairs of words of one colour agree but for their low bits.

    `words` [N, C]: those of three colours take turns from column `first` on.
    """
    count = (words.shape[1] - first) // 3
    high = np.empty((3, count), np.uint32)  # so that the innermost loop is one of vectors
    for i in range(len(words)):
        for j in range(3 * count):
            high[j % 3, j // 3] = (words[i, first + j] & _MAGNITUDE) >> shifts[first + j]
        equal = 0
        for colour in range(3):
            for b in range(count):
                for a in range(b):
                    equal += high[colour, a] == high[colour, b]
        found[i] |= equal >= most


@kernel
def count_zeros(words, chosen, zeros, counts):
    """How many of the words [N, C] of `chosen` rows [N] have which exponent and trailing zeros.

    `counts` [256, most + 1]; `zeros` [2^most]: of every number, and `most` of 0.
    """
    for i in range(len(words)):
        if chosen[i]:
            for j in range(words.shape[1]):
                word = words[i, j]
                counts[word >> np.uint32(23) & np.uint32(255), zeros[word & np.uint32(len(zeros) - 1)]] += 1
