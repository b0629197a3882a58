"""What is done with cells between one call of AES and the next, compiled; see `cells`.

All take the rows of some Gaussians: `names` [N, 16] their identities, `slots` [N] or one for all, as an array
of one, and messages [N, 16 k]: slot, data of a cell, and zeros.

The kernels may use nothing else of other files: they would outlive their change, see `rendering.cpu.jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

from keyss.rendering.cpu.jit import exact_kernel


@exact_kernel
def begin(slots, data, messages):
    """Fill `messages` with `data` [N, size]."""
    size = data.shape[1]
    for row in range(len(messages)):
        messages[row, 0] = slots[row] if len(slots) > 1 else slots[0]
        for i in range(size):
            messages[row, 1 + i] = data[row, i]
        for i in range(1 + size, messages.shape[1]):
            messages[row, i] = 0


@exact_kernel
def chain(states, messages, block):
    """The next block of each message on `states` [N, 16]."""
    for row in range(len(states)):
        for i in range(16):
            states[row, i] ^= messages[row, 16 * block + i]


@exact_kernel
def seed(names, slots, tags, tag_bytes, seeds):
    """`seeds` [N, 16]: the name with the tag and the slot on it."""
    for row in range(len(names)):
        for i in range(16):
            seeds[row, i] = names[row, i]
        for i in range(tag_bytes):
            seeds[row, i] ^= tags[row, i]
        seeds[row, tag_bytes] ^= slots[row] if len(slots) > 1 else slots[0]


@exact_kernel
def count(seeds, counted):
    """`counted` [N, B, 16]: each seed with the numbers from 0 on."""
    for row in range(len(seeds)):
        for block in range(counted.shape[1]):
            for i in range(16):
                counted[row, block, i] = seeds[row, i]
            counted[row, block, 15] ^= block


@exact_kernel
def cover(data, first, streams, out, begin):
    """`out` from column `begin` on: `data` from column `first` on with key `streams` [N, size or more]."""
    size = min(data.shape[1] - first, out.shape[1] - begin)
    for row in range(len(data)):
        for i in range(size):
            out[row, begin + i] = data[row, first + i] ^ streams[row, i]


@exact_kernel
def fit(states, cells, tag_bytes, messages, size, rows, out):
    """Put the data in `messages` whose tags [N, 16] are those of their `cells` in `out`; returns how many.

    `rows`: which they are.
    """
    found = 0
    for row in range(len(states)):
        differs = 0
        for i in range(tag_bytes):
            differs |= states[row, i] ^ cells[row, i]
        if differs == 0:
            rows[found] = row
            for i in range(size):
                out[found, i] = messages[row, 1 + i]
            found += 1
    return found
