"""Foreign Gaussians: those that were added to a model, or changed, after secrets were hidden in it.

A payload has a *record* of its model: a *Bloom filter* (Bloom 1970) of its Gaussians, by which a reader
detects others. The filter has B bits and one keyed hash. Each Gaussian hashes to one of `among` places, and
those below B are bits: a sample of the Gaussians, in which each is present with probability B / `among`. The
bits of its own Gaussians are set, so losses do not matter. Of foreign ones in the sample, a share e^-1 hits
unset bits if the filter holds B Gaussians. Equal IDs count once.

Low bits have the *exact* record: an ID is a hash of all bits that stay. Appended Gaussians have the *coarse*
one, which formats and motions leave as it is. Numbers of a Gaussian in the own frame (position, log scales,
opacity, colours) are rounded to *bins*, whose indices are the ID. Borders depend on the key, and those of
numbers other than positions also on the position's bin: nobody else can move Gaussians next to them, and
equal numbers are next to a border in few places only. A reader leaves out Gaussians next to a border, which a
format may have moved across it; a writer leaves out none.

Of the coarse filter's sample, half is drawn by number, half by size: an attacker who adds few Gaussians that
cover much, or many specks, is noticed alike. The IDs fix sizes and places relative to the appended Gaussians,
so the cover's own Gaussians count only where and as large as they were, once each. Gaussians that the filter
cannot tell apart are counted: those too faint for it, because many in one place are visible, and those out of
the bins' range, into which a model that is far larger or smaller than the cover falls as a whole.

Colours have no record, which would take most of a small payload: there, agreement with the decoded code tells
foreign Gaussians. Quantised values have none: the salt depends on all colours and opacities.
"""

from __future__ import annotations

import math
import os
import struct

import numpy as np
import torch

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bytes, Doubles, Flags, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import expand

_MAX_COPIES = 0.1  # share of a sound model; one public model has 0.035, all others less
_COPIED = 2 / 255  # opacity, above that of appended Gaussians

_EXACT = struct.Struct("<I32s")  # Gaussians; Bloom filter
EXACT_BYTES = _EXACT.size

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
# Least share of foreign Gaussians that causes a warning. Conversions make none foreign; of another model,
# 0.95 and more are.
_LEAST_SHARE = 0.05
# Numbers of faint, of out-of-range and of visible Gaussians; area; Bloom filter.
_COARSE = struct.Struct(f"<IIIf{_BLOOM_BYTES}s")
COARSE_BYTES = _COARSE.size


def copies(model: Gaussians) -> tuple[int, bool]:
    """The number of visible Gaussians with the position and the red of another; True if it is suspicious.

    A file merged from two files of one cover has many: no channel changes these numbers.
    """
    visible = torch.cat([model.means, model.sh[:, 0, :1]], dim=1)[model.opacities > _COPIED]
    rows = visible.detach().cpu().numpy() + np.float32(0)  # no -0
    weights = np.frombuffer(os.urandom(32), np.uint64)  # random: nobody can prepare equal hashes
    hashes = np.sort(rows.view(np.uint32).astype(np.uint64) @ weights)
    count = int((hashes[1:] == hashes[:-1]).sum())
    return count, count > _MAX_COPIES * len(rows)


def bloom_filter(secret: bytes, ids: Bytes, size: int, among: Integers | int) -> bytes:
    """A Bloom filter of `size` bytes of Gaussians with `ids` [N, 16].

    `among` [N]: places that each hashes to, a function of its ID; or N.
    """
    bits = np.zeros(8 * size, np.uint8)
    bits[_places(secret, ids, among, len(bits))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign_share(secret: bytes, ids: Bytes, bloom: bytes, among: Integers | int, gone: float = 0.0) -> float:
    """Estimated share, 0 to 1, of foreign Gaussians among those with `ids` [M, 16], by the filter `bloom`.

    `among` [M]: as in `bloom_filter`, if Gaussians count in inverse proportion to it; else the number of its
    Gaussians. 1 if less than a share `gone` of the Bloom filter's sample, rounded down, is there.
    """
    unset = np.unpackbits(np.frombuffer(bloom, np.uint8), bitorder="little") == 0
    places = _places(secret, ids, among, len(unset))
    if isinstance(among, int):
        unset = unset[:among]
    if len(places) < math.floor(gone * (~unset).sum()):
        return 1.0
    return min(1.0, float(unset[places].sum() / max(1e-9, len(places) * unset.mean())))


def _places(secret: bytes, ids: Bytes, among: Integers | int, kept: int) -> Integers:
    """Places below `kept` [P] of different IDs."""
    hashed = encrypted_blocks(expand(secret, "bloom", 32), ids)[:, :8].copy().view("<u4").astype(np.int64)
    places = hashed[:, 0] % np.maximum(1, among)
    sampled = np.flatnonzero(places < kept)
    _, first = np.unique(hashed[sampled, 0] << 32 | hashed[sampled, 1], return_index=True)
    return places[sampled[first]]


def exact_record(secret: bytes, ids: Bytes) -> bytes:
    """The record of a model of Gaussians with `ids` [N, 16]."""
    return _EXACT.pack(len(ids), bloom_filter(secret, ids, 32, len(ids)))


def exact_foreign(record: bytes, secret: bytes, ids: Bytes) -> int:
    """Estimated number of foreign Gaussians among those with `ids` [M, 16]."""
    count, bloom = _EXACT.unpack(record)
    return math.ceil(len(ids) * foreign_share(secret, ids, bloom, count))


def coarse_record(secret: bytes, cover: Gaussians, appended: int, to_own: Similarity) -> bytes:
    """The record of a cover and the number of Gaussians `appended` to it; `to_own`: world to own frame."""
    ids, areas, outside = _in_bins(cover, to_own, secret, reading=False)
    area = float(np.float32(areas.sum()))
    bloom = bloom_filter(secret, ids, _BLOOM_BYTES, _among(areas, len(ids), area))
    return _COARSE.pack(_faint(cover) + appended, outside, len(ids), area, bloom)


def coarse_foreign(record: bytes, secret: bytes, model: Gaussians, to_own: Similarity) -> int:
    """Estimated number of a model's Gaussians that are foreign to the cover of a `coarse_record`.

    0 if they are at most a share _LEAST_SHARE. All are foreign if hardly anything is left of the cover.
    """
    faint, outside_before, count, area, bloom = _COARSE.unpack(record)
    here, (ids, areas, outside) = _faint(model), _in_bins(model, to_own, secret, reading=True)
    visible = len(model) - here
    foreign = foreign_share(secret, ids, bloom, _among(areas, count, area), _GONE)
    sure = round(foreign * visible) if foreign > _LEAST_SHARE else 0
    if outside > outside_before + _LEAST_SHARE * visible:
        sure = max(sure, outside - outside_before)
    return sure + (here - faint if here > _MORE * faint else 0)


def _in_bins(
    model: Gaussians, to_own: Similarity, secret: bytes, reading: bool
) -> tuple[Bytes, Doubles, int]:
    """IDs [M, 16] of Gaussians in bins, opacity x area [M] of their bins, and how many are out of range."""
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
    borders = encrypted_blocks(expand(secret, "borders", 32), blocks.view(np.uint8))
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
    return ids.view(np.uint8), areas, outside


def _among(areas: Doubles, count: int, area: float) -> Integers:
    """Places [M] in the Bloom filter of a cover with `count` Gaussians and a total `area`."""
    places = np.rint(2 / (1 / max(1, count) + areas / max(1e-30, area)))
    return places.astype(np.int64).clip(8 * _BLOOM_BYTES)


def _faint(model: Gaussians) -> int:
    return int((model.opacities <= _VISIBLE[1]).sum())


def _offsets(random: Bytes) -> Doubles:
    """Offsets of borders, in bins."""
    offsets: Doubles = (random + 0.5) / 256
    return offsets
