"""The order in which a file stores Gaussians, and the order in which a reader counts their bits.

They are the same for formats that keep the order of Gaussians. A .sog is stored in Morton order of positions,
which carry bits; its bits are counted in the order of hashes of the codes that carry none.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from keyss.channels.mixing import row_hashes
from keyss.channels.quiet.fields import Field, carrying, sog_distances
from keyss.channels.quiet.usable import repeated
from keyss.core.arrays import Doubles, Flags, Floats, Integers, Words
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import Codes, morton_order
from keyss.files.formats.sog import SogCodes

_SOG_ARRAYS = ("positions", "largest", "rotations", "scales", "colors", "alphas", "labels")


def in_counted_order(codes: Codes, exact: Flags | None = None) -> tuple[Integers, Any, list[Field]]:
    """The order [N] in which bits are counted, the codes in this order, and their fields.

    No bits: Gaussians that are not `exact` [N] (see `Decoded`), and Gaussians of a .sog with equal hashes.
    """
    rows = np.arange(len(codes))
    silent = np.zeros(len(codes), np.bool_) if exact is None else ~exact
    if isinstance(codes, SogCodes):
        names = _sog_hashes(codes)
        rows, silent = np.argsort(names, kind="stable"), silent | repeated(names)
    codes, silent = in_rows(codes, rows), silent[rows]
    fields = carrying(codes).fields(codes)
    return rows, codes, [replace(each, bits=np.where(silent, 0, each.bits)) for each in fields]


def model_hash(codes: Any, decoded: Gaussians | None = None) -> bytes:
    """12 bytes of a hash of colours and opacities, which never change; those of `decoded` if given.

    It binds blocks to their model: blocks copied into another one open nothing. Gaussians are in counted
    order, without those of a .sog with equal hashes, whose order is undefined.
    """
    if decoded is None:
        words = np.column_stack([codes.colors, codes.alphas]).astype("<u4")
    else:
        words = torch.column_stack([decoded.sh[:, 0], decoded.opacity_logits]).float().numpy().view("<u4")
    if isinstance(codes, SogCodes):
        words = words[~repeated(_sog_hashes(codes))]
    return hashlib.sha256(b"keyss/v1/host" + words.tobytes()).digest()[:12]


def file_order(codes: Codes, within: Doubles) -> Integers:
    """The rows [N] as a writer of the format stores them.

    Writers sort before they round, so a few neighbours seem out of order. `within` [N, 3]: random rounding
    errors in [-0.5, 0.5], in levels; extremes have none.
    """
    if not isinstance(codes, SogCodes):
        return np.arange(len(codes))
    levels = codes.positions
    extreme = (levels == levels.min(axis=0)) | (levels == levels.max(axis=0))
    means: Floats = codes.positions_at(levels + np.where(extreme, 0.0, within)).astype(np.float32)
    return morton_order(means)


def in_rows(codes: Codes, rows: Integers) -> Any:
    """The Gaussians of `codes` in the order `rows` [N]; formats other than .sog keep theirs."""
    if not isinstance(codes, SogCodes):
        return codes
    return replace(codes, **{name: getattr(codes, name)[rows] for name in _SOG_ARRAYS})


def _sog_hashes(codes: SogCodes) -> Words:
    """[N] hashes of the codes that are never written."""
    parts = (codes.scales, codes.colors, codes.alphas, codes.labels, codes.largest)
    levels = sog_distances(codes, codes.positions)
    return row_hashes(np.concatenate([each.reshape(len(levels), -1) for each in (*parts, levels)], axis=1))
