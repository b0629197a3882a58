"""Loops over the bits of whole models, which NumPy would take dozens of passes for.

Kernels take rows of words [N, C] and write one result for each row.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import kernel

_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: the high bits of multiples are scattered
_MAGNITUDE = np.uint32(0x7FFFFFFF)
_TWELVE = np.uint32((1 << 12) - 1)


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
def find_full(words, shift, full, found):
    """`found` [N, C]: whether the bucket of each of `words` [N, C] is `full`, of which each has a bit."""
    for i in range(len(words)):
        for j in range(words.shape[1]):
            at = np.uint64(words[i, j]) * _ODD >> np.uint64(shift)
            found[i, j] = full[at >> np.uint64(3)] >> np.uint8(at & np.uint64(7)) & np.uint8(1)


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


@kernel
def pack_harmonics(words, unused, packed):
    """`packed` [N, C * 3 // 2]: 12 bits above the `unused` ones of words [N, C], two times 12 in three bytes.

    Of the last of an odd number of words only the upper 8 bits.
    """
    for i in range(len(words)):
        for j in range(0, words.shape[1], 2):
            at = j // 2 * 3
            first = words[i, j] >> unused & _TWELVE
            packed[i, at] = first >> np.uint32(4)
            if j + 1 < words.shape[1]:
                second = words[i, j + 1] >> unused & _TWELVE
                packed[i, at + 1] = (first & np.uint32(15)) << np.uint32(4) | second >> np.uint32(8)
                packed[i, at + 2] = second & np.uint32(255)


@kernel
def unpack_harmonics(packed, unused, rows, words):
    """The inverse of `pack_harmonics`, into the words [N, C] of `rows` [R]; other bits stay as they are."""
    for r in range(len(rows)):
        own = words[rows[r]]
        for j in range(0, len(own), 2):
            at = j // 2 * 3
            first, kept = np.uint32(packed[r, at]) << np.uint32(4), _TWELVE - np.uint32(15)
            if j + 1 < len(own):
                middle = np.uint32(packed[r, at + 1])
                first, kept = first | middle >> np.uint32(4), _TWELVE
                second = (middle & np.uint32(15)) << np.uint32(8) | np.uint32(packed[r, at + 2])
                own[j + 1] = own[j + 1] & ~(_TWELVE << unused) | second << unused
            own[j] = own[j] & ~(kept << unused) | first << unused
