"""Salts of Argon2id: hashes of a Gaussian and its low bits, which carry nothing else.

They are new for every file: no two files of one cover share a salt. There are several because Gaussians may
be removed. Embedding keeps their order: by ID, but last are Gaussians that are often not usable.
"""

from __future__ import annotations

import hashlib

import numpy as np
import torch

from keyss.channels.lsb.bits import BLOCK, LEAST, Layout, exponents, read_low_bits, used_words
from keyss.channels.lsb.equal_steps import moved_from_zero
from keyss.core.arrays import Bytes, Integers, Words
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import SALT_BYTES

SALTS = 12  # random pruning of a quarter removes all their Gaussians with p = 6e-8
_LABEL = b"keyss/v1/salt"
_LARGE_ENOUGH = 118  # biased exponent: optimisers with large last steps leave zeros in numbers below 2^-9
_FIRST = 1 << 12  # smallest IDs, enough for the salts of most models


def salt_rows(gaussians: Gaussians, ids: Bytes, layout: Layout) -> Integers:
    """Rows of the salts' Gaussians, at most SALTS, in the order of the salts; `ids` [N, 16]."""
    numbers = ids[:, :8].copy().view(">u8")[:, 0].astype(np.uint64)
    rows = np.argpartition(numbers, _FIRST)[:_FIRST] if len(ids) > _FIRST else np.arange(len(ids))
    ranks = _ranks(gaussians[torch.from_numpy(rows)], layout)
    if (ranks == 0).sum() < SALTS:  # too few among the smallest IDs
        rows, ranks = np.arange(len(ids)), _ranks(gaussians, layout)
    keys = ranks << np.uint64(56) | numbers[rows] >> np.uint64(8)
    best = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    low = read_low_bits(gaussians[torch.from_numpy(rows[best])], LEAST, layout)
    places = [
        (ranks[index], ids[rows[index]].tobytes(), bits.tobytes())
        for index, bits in zip(best, low, strict=True)
    ]
    return rows[best[sorted(range(len(best)), key=places.__getitem__)]]


def _ranks(gaussians: Gaussians, layout: Layout) -> Words:
    """[N] octaves by which the smallest even number lies below _LARGE_ENOUGH, 0 for larger ones.

    255 for Gaussians that moved by equal steps away from zero.
    """

    def rank(start: int, stop: int) -> Words:
        used = used_words(gaussians[start:stop])[:, layout.columns]
        below = np.where(used & 1 == 0, _LARGE_ENOUGH - exponents(used).astype(np.int64), 0)
        octaves: Words = below.max(axis=1, initial=0).astype(np.uint64)
        return octaves

    small = np.concatenate([np.zeros(0, np.uint64), *in_blocks(rank, len(gaussians), BLOCK)])
    return np.where(moved_from_zero(gaussians, layout), np.uint64(255), small)


def salt(carrier_id: Bytes, low: Bytes) -> bytes:
    """The salt of one carrier: SALT_BYTES."""
    return hashlib.sha256(_LABEL + carrier_id.tobytes() + low.tobytes()).digest()[:SALT_BYTES]
