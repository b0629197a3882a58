"""Identities and low bits of large models, some Gaussians at a time: see `keyss.channels.low_bits.bits`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.low_bits import bits as low_bits
from keyss.core.gaussians import Gaussians

_CHUNK = 1 << 16

Bytes = npt.NDArray[np.uint8]


def identities(gaussians: Gaussians) -> Bytes:
    """[N, 16] of each Gaussian what embedding leaves as it is, hashed."""
    names = b"".join(b"".join(low_bits.identities(gaussians[part])) for part in _parts(len(gaussians)))
    return np.frombuffer(names, np.uint8).reshape(-1, low_bits.IDENTITY_BYTES)


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B] the low bits of each Gaussian."""
    return np.concatenate([low_bits.read_low_bits(gaussians[part]) for part in _parts(len(gaussians))])


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with the low bits [R, B] in the `rows` [R], which are different ones."""
    order = np.argsort(rows)
    rows = rows[order]
    result = gaussians.map(torch.clone)
    for part in _parts(len(gaussians)):
        first, last = np.searchsorted(rows, (part.start, part.stop))
        chosen = order[first:last]
        changed = low_bits.write_low_bits(gaussians[part], rows[first:last] - part.start, data[chosen])
        for name in ("quats", "log_scales", "opacity_logits", "sh"):
            getattr(result, name)[part] = getattr(changed, name)
    return result


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, min(count, start + _CHUNK)) for start in range(0, max(count, 1), _CHUNK))
