"""What a payload knows of its cover: a Bloom filter of its Gaussians, as formats and motions leave them.

Numbers of a Gaussian in the own frame (position, log scales, opacity, colours) are rounded to coarse *bins*.
Borders depend on the key, and those of numbers other than positions also on the position's bin: nobody else
can move Gaussians next to them, and equal numbers are next to a border in few places only. A reader leaves
out Gaussians next to a border, which a format may have moved across it; a writer leaves out none.

Of the filter's sample, half is drawn by number, half by size: an attacker who adds few Gaussians that cover
much, or many specks, is noticed alike. The IDs fix sizes and places relative to the appended Gaussians, so
the cover's own Gaussians count only where and as large as they were, once each. Gaussians that the filter
cannot tell apart are counted: those too faint for it, because many in one place are visible, and those out of
the bins' range, into which a model that is far larger or smaller than the cover falls as a whole.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from keyss.channels import mixing
from keyss.core.arrays import Bytes, Doubles, Flags, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import expand

# Of positions (in sides of the cube), log scales, opacity and colours: bins, and maximum rounding errors.
_BINS = np.array([1 / 16] * 3 + [0.5] * 3 + [0.1] + [0.3] * 3)
_ERRORS = np.array([0.002] * 3 + [0.035] * 3 + [0.005] + [0.016] * 3)
_LOW = np.array([-7.0] * 3 + [-8.0] * 3 + [0.0] + [-1.7] * 3)  # formats may clip numbers outside of these
_HIGH = np.array([7.0] * 3 + [4.0] * 3 + [1.0] + [1.7] * 3)
# Minimum opacity for writers and for readers; 8 bits round none across the second.
_VISIBLE = np.array([2.0, 3.5]) / 255
_MORE = 1.25  # factor by which formats may increase the number of faint Gaussians
_GONE = 0.02  # share of the sample; readers of whole covers leave out at most four fifths
_BLOOM_BYTES = 128
# Numbers of faint Gaussians, of those out of range and of all others than faint; area; Bloom filter.
_FORMAT = struct.Struct(f"<IIIf{_BLOOM_BYTES}s")
BYTES = _FORMAT.size


@dataclass(frozen=True)
class _Rows:
    """Gaussians in bins."""

    ids: Bytes  # [M, 16]
    areas: Doubles  # [M] opacity x area in the own frame, of the middle of the bins
    outside: int  # number of Gaussians out of range

    @staticmethod
    def of(model: Gaussians, to_own: Similarity, secret: bytes, reading: bool) -> _Rows:
        means = to_own.apply_points(model.means.detach().double())  # float32 may overflow
        log_scales = doubles(model.log_scales) + math.log(to_own.scale)
        numbers = np.hstack(
            [means.numpy(), log_scales, doubles(model.opacities)[:, None], doubles(model.sh[:, 0])]
        )
        seen = np.isfinite(numbers).all(axis=1) & (numbers[:, 6] > _VISIBLE[int(reading)])
        numbers = numbers[seen].clip(_LOW, _HIGH)
        bounds = np.zeros_like(_ERRORS) if reading else _ERRORS  # a format may move numbers out of range
        far = (numbers <= _LOW + bounds) | (numbers >= _HIGH - bounds)
        outside = int((far[:, :3].any(axis=1) | (far[:, 3:6].sum(axis=1) > 1)).sum())
        steps = numbers / _BINS
        steps[:, :3] += _offsets(np.frombuffer(expand(secret, "bins", 32), np.uint8)[:3])
        blocks = np.zeros((len(steps), 16), np.int8)
        blocks[:, :3] = np.floor(steps[:, :3])
        borders = mixing.encrypted_blocks(expand(secret, "borders", 32), blocks.view(np.uint8))
        offsets = _offsets(borders[:, : len(_BINS) - 3])
        steps[:, 3:] += offsets
        bins = np.floor(steps)
        middles = (bins[:, 3:] + 0.5 - offsets) * _BINS[3:]
        if reading:
            near = np.minimum(steps - bins, bins + 1 - steps) < _ERRORS / _BINS
            sure: Flags = ~(near & (numbers > _LOW) & (numbers < _HIGH)).any(axis=1)
            bins, middles = bins[sure], middles[sure]
        areas = np.exp(np.sort(middles[:, :3])[:, 1:].sum(axis=1)) * middles[:, 3].clip(0.02, 1)
        ids = np.zeros((len(bins), 16), np.int8)
        ids[:, : len(_BINS)] = bins
        return _Rows(ids.view(np.uint8), areas, outside)

    def among(self, count: int, area: float) -> Integers:
        """Places in the Bloom filter of a cover with `count` Gaussians and a total `area`."""
        return (
            np.rint(2 / (1 / max(1, count) + self.areas / max(1e-30, area)))
            .astype(np.int64)
            .clip(8 * _BLOOM_BYTES)
        )


def pack(cover: Gaussians, appended: int, to_own: Similarity, secret: bytes) -> bytes:
    """BYTES bytes by which `foreign_count` detects Gaussians other than the cover's and those `appended`."""
    rows = _Rows.of(cover, to_own, secret, reading=False)
    area = float(np.float32(rows.areas.sum()))
    own = mixing.bloom_filter(secret, rows.ids, _BLOOM_BYTES, rows.among(len(rows.ids), area))
    return _FORMAT.pack(_faint(cover) + appended, rows.outside, len(rows.ids), area, own)


def foreign_count(packed: bytes, model: Gaussians, to_own: Similarity, secret: bytes, share: float) -> int:
    """Estimated number of a model's Gaussians that are foreign to a cover; 0 if they are at most a `share`.

    `packed`: the result of `pack`. All are foreign if hardly anything is left of the cover.
    """
    faint, outside, count, area, own = _FORMAT.unpack(packed)
    here, rows = _faint(model), _Rows.of(model, to_own, secret, reading=True)
    visible = len(model) - here
    foreign = mixing.foreign_share(secret, rows.ids, own, rows.among(count, area), _GONE)
    sure = round(foreign * visible) if foreign > share else 0
    if rows.outside > outside + share * visible:
        sure = max(sure, rows.outside - outside)
    return sure + (here - faint if here > _MORE * faint else 0)


def _faint(model: Gaussians) -> int:
    return int((model.opacities <= _VISIBLE[1]).sum())


def _offsets(random: Bytes) -> Doubles:
    """Offsets of borders, in bins."""
    offsets: Doubles = (random + 0.5) / 256
    return offsets
