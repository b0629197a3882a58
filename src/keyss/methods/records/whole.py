"""A model as one string of bytes, for places where all of it comes out or nothing.

    Gaussians (4 bytes), SH degree (1), step of harmonics (4), codec (see `quantise`),
    columns of codes, packed by LZMA

Gaussians are sorted along a Z-order curve, so that positions differ little from one to the next. Everything
but the harmonics above degree 0 is coded as in records. Of these most are next to nothing: in brightness and
two differences of colours they are divided by the step, what is below 0.6 of it becomes 0, and LZMA makes
little of the zeros (a uniform quantiser with a dead zone; Sullivan 1996).
"""

from __future__ import annotations

import lzma
import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from keyss.core.colour import OPPONENT
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.dither import cost
from keyss.methods.records.encoding import CarriedSecret, most_visible
from keyss.methods.records.packing import Bytes, Codes, codes_of_records, records_of_codes
from keyss.methods.records.quantise import Codec
from keyss.methods.records.table import BANDS, CHROMA_FEWER, Table

MOST_GAUSSIANS = 1 << 22
USUAL_BITS, MOST_BITS = 110, 143  # of all but harmonics: about 48 and 60 dB
_HEAD = struct.Struct("<IBf")
_STEP, _HALVED = 0.05, 20  # of harmonics at the usual bits; with so many more bits it is half as large
_DEAD_ZONE = 0.6  # of a step
_LARGEST = 127  # code of a harmonic
_GOOD_ENOUGH = 44.0  # dB of pictures against those of the model: of photos at 30 dB it takes 0.2
# Of each attribute alone, until they are good enough together; shares of opacities, of which there are fewer
# than of others, and of harmonics, of which more numbers than three become longer.
_GOALS, _BIT = range(47, 61), 6.02  # dB
_ATTRIBUTES, _SHARES = ("means", "log_scales", "quats", "opacity_logits"), (0, 0, 0, 4.8, 0, -8)
_FEWEST = (8, 4, 4, 4, 4)  # bits
FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 22, "lc": 0, "lp": 0, "pb": 0}]
_POSITIONS = range(3, 6)  # among the columns of a layout


class Precision(NamedTuple):
    """How finely a model is coded."""

    table: Table  # of SH degree 0
    step: float  # of harmonics, below 1

    @staticmethod
    def of_size(bits: int) -> Precision:
        """With at most USUAL_BITS to MOST_BITS for all of a Gaussian but harmonics, before packing."""
        table = Table.of_size(bits, 0, Table.short())
        if table is None:
            raise ValueError(f"expected at least {Table.short().total} bits, got {bits}")
        return Precision(table, _STEP * 2 ** ((USUAL_BITS - bits) / _HALVED))


def encode(model: Gaussians, precision: Precision | None = None) -> bytes:
    """`model` with the usual precision, or another."""
    table, step = precision or Precision.of_size(USUAL_BITS)
    model = in_morton_order(model)
    plain = model.with_sh_degree(0)
    codec = Codec.fit(plain, table)
    columns = codes_of_records(codec.encode(plain), _layout(table))
    planes = [plane for i, each in enumerate(columns) for plane in _planes(each, _layout(table)[i][1], i)]
    packed = lzma.compress(b"".join(planes) + _harmonics(model, step), lzma.FORMAT_RAW, filters=FILTERS)
    return _HEAD.pack(len(model), model.sh_degree, step) + codec.pack() + packed


def decode(data: bytes) -> CarriedSecret:
    """The model of `encode`. Raises InputError for damage; no more memory is taken than `data` may hold."""
    if len(data) < _HEAD.size:
        raise InputError("the hidden secret is damaged: it is too short")
    count, sh_degree, step = _HEAD.unpack_from(data)
    codec = Codec.unpack(data[_HEAD.size :])
    if not (0 < count <= MOST_GAUSSIANS and sh_degree <= 3 and codec.table.sh_degree == 0 and 0 < step < 1):
        raise InputError(
            f"the hidden secret is damaged: it announces {count:,} Gaussians of SH degree {sh_degree}"
        )
    layout, harmonics = _layout(codec.table), 3 * ((sh_degree + 1) ** 2 - 1)
    own = count * sum(columns * -(-bits // 8) for columns, bits in layout)
    start = _HEAD.size + Codec.packed_size(0)
    size = own + count * harmonics
    try:
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
        planes = unpacker.decompress(data[start:], size + 1)
    except lzma.LZMAError as error:
        raise InputError(f"the hidden secret is damaged: {error}") from error
    if len(planes) != size or not unpacker.eof or unpacker.unused_data:
        raise InputError("the hidden secret is damaged: it is not whole")
    found, at = [], 0
    for index, (columns, bits) in enumerate(layout):
        width = columns * -(-bits // 8) * count
        part = np.frombuffer(planes, np.uint8, width, at)
        found.append(_from_planes(part.reshape(columns, -1, count), bits, index))
        at += width
    plain = codec.decode(records_of_codes(found, layout))
    codes = np.frombuffer(planes, np.int8, offset=own).reshape(harmonics // 3, 3, count).transpose(2, 0, 1)
    numbers = torch.from_numpy((codes * float(step)) @ OPPONENT).float()
    gaussians = Gaussians(
        plain.means, plain.quats, plain.log_scales, plain.opacity_logits, torch.cat([plain.sh, numbers], 1)
    )
    return CarriedSecret(gaussians, count, round(8 * len(data) / count))


def good_enough(model: Gaussians) -> Precision:
    """The coarsest precision of which the pictures are good enough, as far as few tries tell.

    What an attribute costs alone is measured once, and 6 dB are a bit. The fewest bits in all are those with
    which the squared error of each is in proportion to the numbers that a bit more is spent on.
    """
    table, step = Precision.of_size(Table.short().total)
    rough = decode(encode(model, Precision(table, step))).gaussians
    model = in_morton_order(model)
    constant = replace(model, sh=torch.cat([rough.sh[:, :1], model.sh[:, 1:]], 1))
    harmonics = replace(model, sh=torch.cat([model.sh[:, :1], rough.sh[:, 1:]], 1))
    changed = [replace(model, **{name: getattr(rough, name)}) for name in _ATTRIBUTES]
    costs = [cost(model, each) for each in (*changed, constant, harmonics)]
    for goal in _GOALS:
        missing = [goal + more - each for more, each in zip(_SHARES, costs, strict=True)]
        bits = (each + math.ceil(dB / _BIT) for each, dB in zip(table.bits, missing, strict=False))
        found = Table(tuple(min(max(each, least), 20) for each, least in zip(bits, _FEWEST, strict=True)))
        precision = Precision(found, min(0.9, step * 10 ** (-missing[-1] / 20)))
        if cost(model, decode(encode(model, precision)).gaussians) >= _GOOD_ENOUGH:
            break
    return precision


def least_bytes(model: Gaussians) -> int:
    """Of the encoding below which a secret is rather pruned."""
    return len(encode(model))


def fitted(model: Gaussians, room: int, *, prune: bool, short: bool = False) -> tuple[Gaussians, bytes]:
    """What of `model` is encoded, and it in at most `room` bytes, as precise as it fits.

    `short`: no more precise than is hard to see. If all of it does not fit, `prune` takes the most visible
    Gaussians, of the SH degree that renders most like the model. Raises UsageError without `prune`, or where
    nothing fits.
    """
    least = encode(model, good_enough(model) if short else None)
    if len(least) <= room:
        return model, least if short else _most_precise(model, least, room)
    if not prune:
        raise UsageError(
            f"the secret of {len(model):,} Gaussians takes {len(least):,} bytes, and there is room for "
            f"{room:,}: about {max(0, len(model) * room // len(least)):,} of its Gaussians"
        )
    candidates = []
    for degree in range(model.sh_degree + 1):
        found = _pruned(model.with_sh_degree(degree), room)
        if found is not None:
            candidates.append(found)
    if not candidates:
        raise UsageError(f"nothing of a secret fits into {room:,} bytes")
    kept, data = max(candidates, key=lambda each: cost(model, each[0]))
    return kept, _most_precise(kept, data, room)


def _pruned(model: Gaussians, room: int) -> tuple[Gaussians, bytes] | None:
    """The most visible Gaussians that fit into `room` bytes; None if not even one does."""
    count = len(model)
    while count > 0:
        kept = most_visible(model, count)
        data = encode(kept)
        if len(data) <= room:
            return kept, data
        count = min(count - 1, int(0.995 * count * room / len(data)))
    return None


def _most_precise(model: Gaussians, usual: bytes, room: int) -> bytes:
    """The longest encoding that fits, `usual` being that of the usual bits."""
    more = 8 * (room - len(usual)) // len(model)
    for bits in range(min(MOST_BITS, USUAL_BITS + more), USUAL_BITS, -2):
        data = encode(model, Precision.of_size(bits))
        if len(data) <= room:
            return data
    return usual


def _harmonics(model: Gaussians, step: float) -> bytes:
    """Of each coefficient above degree 0 the codes of brightness and two differences, a byte each."""
    numbers = model.sh[:, 1:].detach().cpu().numpy().astype(np.float64) @ OPPONENT.T / step
    codes = np.floor(np.abs(numbers) + 1 - _DEAD_ZONE).clip(0, _LARGEST) * np.sign(numbers)
    return codes.astype(np.int8).transpose(1, 2, 0).tobytes()


def _layout(table: Table) -> list[tuple[int, int]]:
    """(columns, bits) in the order of records: outlier, largest part; positions; ... (see `quantise`)."""
    means, log_scales, quats, opacity, *colours = table.bits
    layout = [(1, 1), (1, 2), (3, quats), (1, means), (1, means), (1, means), (3, log_scales), (1, opacity)]
    for count, bits in zip(BANDS, colours, strict=False):
        layout += [(count, bits), (2 * count, bits - CHROMA_FEWER)]
    return layout


def _planes(codes: Codes, bits: int, index: int) -> Sequence[bytes]:
    """Of each column of codes [N, C] the lowest bytes, then the higher ones; positions as differences."""
    if index in _POSITIONS:
        codes = codes.copy()
        codes[1:] -= codes[:-1].copy()
        codes &= np.uint32((1 << bits) - 1)
    shifts = range(0, bits, 8)
    return [(column >> np.uint32(shift)).astype(np.uint8).tobytes() for column in codes.T for shift in shifts]


def _from_planes(planes: Bytes, bits: int, index: int) -> Codes:
    """[N, C] codes of the planes [C, bytes, N]; the inverse of `_planes`."""
    codes = np.zeros((planes.shape[2], planes.shape[0]), np.uint32)
    for plane in range(planes.shape[1]):
        codes |= planes[:, plane].T.astype(np.uint32) << np.uint32(8 * plane)
    if index in _POSITIONS:
        codes = np.cumsum(codes, axis=0, dtype=np.uint32)
    return codes & np.uint32((1 << bits) - 1)
