"""The identity of every Gaussian, compiled: BLAKE2b (RFC 7693) of a row of numbers.

A library's BLAKE2b takes one message at a call, and the call takes longer than the hash of so short a one.
The kernel may use nothing else of other files: it would outlive their change, see `rendering.cpu.jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import exact_inlined, exact_kernel

IDENTITY_BYTES = 16
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
def _mix(a, b, c, d, x, y):
    """The function G of RFC 7693, 3.1."""
    a = a + b + x
    d = d ^ a
    d = (d >> _ROTATE[0]) | (d << _BACK[0])
    c = c + d
    b = b ^ c
    b = (b >> _ROTATE[1]) | (b << _BACK[1])
    a = a + b + y
    d = d ^ a
    d = (d >> _ROTATE[2]) | (d << _BACK[2])
    c = c + d
    b = b ^ c
    b = (b >> _ROTATE[3]) | (b << _BACK[3])
    return a, b, c, d


@exact_inlined
def _compress(h, m, length, last):
    """One block of 16 words `m` into the state `h` [8] (RFC 7693, 3.2); `length`: bytes up to its end."""
    v0, v1, v2, v3 = h[0], h[1], h[2], h[3]
    v4, v5, v6, v7 = h[4], h[5], h[6], h[7]
    v8, v9, v10, v11 = _IV[0], _IV[1], _IV[2], _IV[3]
    v12, v13, v14, v15 = _IV[4] ^ length, _IV[5], _IV[6], _IV[7]
    if last:
        v14 = ~v14
    for turn in range(12):
        s = _SIGMA[turn]
        v0, v4, v8, v12 = _mix(v0, v4, v8, v12, m[s[0]], m[s[1]])
        v1, v5, v9, v13 = _mix(v1, v5, v9, v13, m[s[2]], m[s[3]])
        v2, v6, v10, v14 = _mix(v2, v6, v10, v14, m[s[4]], m[s[5]])
        v3, v7, v11, v15 = _mix(v3, v7, v11, v15, m[s[6]], m[s[7]])
        v0, v5, v10, v15 = _mix(v0, v5, v10, v15, m[s[8]], m[s[9]])
        v1, v6, v11, v12 = _mix(v1, v6, v11, v12, m[s[10]], m[s[11]])
        v2, v7, v8, v13 = _mix(v2, v7, v8, v13, m[s[12]], m[s[13]])
        v3, v4, v9, v14 = _mix(v3, v4, v9, v14, m[s[14]], m[s[15]])
    h[0] ^= v0 ^ v8
    h[1] ^= v1 ^ v9
    h[2] ^= v2 ^ v10
    h[3] ^= v3 ^ v11
    h[4] ^= v4 ^ v12
    h[5] ^= v5 ^ v13
    h[6] ^= v6 ^ v14
    h[7] ^= v7 ^ v15


@exact_kernel
def identify(start, stop, means, scales, quats, opacities, sh, mask, hashes):
    """`hashes` [N, 2] uint64: BLAKE2b-128 of position and fields without the bits in use."""
    fields = len(mask)
    words = 3 + fields
    blocks = (4 * words + 127) // 128
    message = np.zeros(32 * blocks, np.uint32)
    pairs = message.view(np.uint64)  # little-endian
    h = np.empty(8, np.uint64)
    for row in range(start, stop):
        for i in range(3):
            message[i] = means[row, i]
        for i in range(3):
            message[3 + i] = scales[row, i] & ~mask[i]
        for i in range(4):
            message[6 + i] = quats[row, i] & ~mask[3 + i]
        message[10] = opacities[row] & ~mask[7]
        for i in range(3, sh.shape[1]):
            message[8 + i] = sh[row, i] & ~mask[5 + i]
        for i in range(8):
            h[i] = _START[i]
        for block in range(blocks):
            last = block == blocks - 1
            length = np.uint64(4 * words if last else 128 * (block + 1))
            _compress(h, pairs[16 * block : 16 * block + 16], length, last)
        hashes[row, 0] = h[0]
        hashes[row, 1] = h[1]
