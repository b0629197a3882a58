"""The identity of every Gaussian, compiled: BLAKE2b (RFC 7693) of a row of numbers.

A library's BLAKE2b takes one message at a call, and the call takes longer than the hash of so short a one.
The kernel may use nothing else of other files: it would outlive their change, see `rendering.cpu.jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import exact_inlined, exact_kernel

IDENTITY_BYTES = 16
LANES = 32  # rows that are hashed side by side, for vector instructions
PERSONALISATION = b"keyss/identity"

_IV = np.array(
    [
        0x6A09E667F3BCC908, 0xBB67AE8584CAA73B, 0x3C6EF372FE94F82B, 0xA54FF53A5F1D36F1,
        0x510E527FADE682D1, 0x9B05688C2B3E6C1F, 0x1F83D9ABFB41BD6B, 0x5BE0CD19137E2179,
    ],
    np.uint64,
)  # fmt: skip
# The first word of the parameter block: 16 bytes of digest, no key, fanout and depth 1 (RFC 7693, 2.5).
_PARAMETERS = np.zeros(8, np.uint64)
_PARAMETERS[0] = 0x01010000 ^ IDENTITY_BYTES
_PARAMETERS[6:] = np.frombuffer(PERSONALISATION.ljust(16, b"\0"), "<u8")
_START = _IV ^ _PARAMETERS
_SIGMA = np.array(
    [
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
        [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4],
        [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
        [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13],
        [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
        [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11],
        [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
        [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5],
        [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
    ],
    np.uint64,  # as indices, these need not be held to be negative
)  # fmt: skip
_ROTATE = tuple(np.uint64(each) for each in (32, 24, 16, 63))
_BACK = tuple(np.uint64(64 - int(each)) for each in _ROTATE)


@exact_inlined
def _mix(v, a, b, c, d, m, x, y):
    """The function G of RFC 7693, 3.1, of all lanes."""
    for lane in range(LANES):
        p = v[a, lane] + v[b, lane] + m[x, lane]
        s = v[d, lane] ^ p
        s = (s >> _ROTATE[0]) | (s << _BACK[0])
        r = v[c, lane] + s
        q = v[b, lane] ^ r
        q = (q >> _ROTATE[1]) | (q << _BACK[1])
        p = p + q + m[y, lane]
        s = s ^ p
        s = (s >> _ROTATE[2]) | (s << _BACK[2])
        r = r + s
        q = q ^ r
        v[a, lane], v[c, lane], v[d, lane] = p, r, s
        v[b, lane] = (q >> _ROTATE[3]) | (q << _BACK[3])


@exact_inlined
def _compress(h, v, m, length, last):
    """One block of 16 words `m` into the states `h` (RFC 7693, 3.2); `length`: bytes up to its end."""
    for i in range(8):
        for lane in range(LANES):
            v[i, lane] = h[i, lane]
            v[8 + i, lane] = _IV[i]
    for lane in range(LANES):
        v[12, lane] ^= length
        if last:
            v[14, lane] = ~v[14, lane]
    for turn in range(12):
        s = _SIGMA[turn]
        _mix(v, 0, 4, 8, 12, m, s[0], s[1])
        _mix(v, 1, 5, 9, 13, m, s[2], s[3])
        _mix(v, 2, 6, 10, 14, m, s[4], s[5])
        _mix(v, 3, 7, 11, 15, m, s[6], s[7])
        _mix(v, 0, 5, 10, 15, m, s[8], s[9])
        _mix(v, 1, 6, 11, 12, m, s[10], s[11])
        _mix(v, 2, 7, 8, 13, m, s[12], s[13])
        _mix(v, 3, 4, 9, 14, m, s[14], s[15])
    for i in range(8):
        for lane in range(LANES):
            h[i, lane] ^= v[i, lane] ^ v[8 + i, lane]


@exact_kernel
def identify(start, stop, means, scales, quats, opacities, sh, mask, hashes):
    """`hashes` [N, 2] uint64: BLAKE2b-128 of position and fields without the bits in use."""
    fields = len(mask)
    words = 3 + fields
    blocks = (4 * words + 127) // 128
    message = np.zeros(32 * blocks, np.uint32)
    pairs = message.view(np.uint64)  # little-endian
    messages = np.zeros((16 * blocks, LANES), np.uint64)
    h, v = np.empty((8, LANES), np.uint64), np.empty((16, LANES), np.uint64)
    for first in range(start, stop, LANES):
        rows = min(LANES, stop - first)
        for lane in range(rows):
            row = first + lane
            for i in range(3):
                message[i] = means[row, i]
                message[3 + i] = scales[row, i] & ~mask[i]
            for i in range(4):
                message[6 + i] = quats[row, i] & ~mask[3 + i]
            message[10] = opacities[row] & ~mask[7]
            for i in range(3, sh.shape[1]):
                message[8 + i] = sh[row, i] & ~mask[5 + i]
            for i in range(len(pairs)):
                messages[i, lane] = pairs[i]
        for i in range(8):
            for lane in range(LANES):
                h[i, lane] = _START[i]
        for block in range(blocks):
            last = block == blocks - 1
            length = np.uint64(4 * words if last else 128 * (block + 1))
            _compress(h, v, messages[16 * block : 16 * block + 16], length, last)
        for lane in range(rows):
            hashes[first + lane, 0] = h[0, lane]
            hashes[first + lane, 1] = h[1, lane]
