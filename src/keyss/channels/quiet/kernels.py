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
def find_near(words, shifts, groups, colours, most, found):
    """`found` [N]: whether two words of a group nearly agree, or `most` pairs of words of one colour agree.

    Both but for the low bits of `words` [N, C], which are shifted away by `shifts` [C]. `groups` [G, 2]: the
    first column of each and how many there are. From column `colours` on, harmonics of three colours take
    turns: each three are a group, too.
    """
    count = (words.shape[1] - colours) // 3
    high = np.empty(words.shape[1], np.int64)
    by_colour = np.empty((3, count), np.int64)  # so that the innermost loop is one of vectors
    for i in range(len(words)):
        near = False
        for j in range(len(high)):
            high[j] = (words[i, j] & _MAGNITUDE) >> shifts[j]
        for g in range(len(groups)):
            for a in range(groups[g, 0], groups[g, 0] + groups[g, 1]):
                for b in range(a + 1, groups[g, 0] + groups[g, 1]):
                    near |= abs(high[a] - high[b]) <= 1
        for j in range(count):
            red, green, blue = high[colours + 3 * j : colours + 3 * j + 3]
            near |= abs(red - green) <= 1 or abs(red - blue) <= 1 or abs(green - blue) <= 1
            by_colour[0, j], by_colour[1, j], by_colour[2, j] = red, green, blue
        equal = 0
        for colour in range(3):
            for b in range(count):
                for a in range(b):
                    equal += by_colour[colour, a] == by_colour[colour, b]
        found[i] = near or equal >= most


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
