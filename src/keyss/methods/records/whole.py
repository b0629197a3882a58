"""A model as one string of bytes, for places where all of it comes out or nothing.

    Gaussians (4 bytes), codec (see `quantise`), records column by column, packed by LZMA

Records lose nothing by it. Their Gaussians are sorted along a Z-order curve, so that positions differ little
from one to the next: of the 123 bits that a Gaussian of SH degree 0 takes at least, 97 to 105 are left.
"""

from __future__ import annotations

import lzma
import struct
from collections.abc import Sequence

import numpy as np

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.dither import cost
from keyss.methods.records.encoding import CarriedSecret, most_visible
from keyss.methods.records.packing import Bytes, Codes, codes_of_records, records_of_codes
from keyss.methods.records.quantise import Codec
from keyss.methods.records.table import BANDS, Table, chroma_bits

MOST_GAUSSIANS = 1 << 22
_COUNT = struct.Struct("<I")
_GOOD_ENOUGH = 44.0  # dB of pictures against those of the model: of photos at 30 dB it takes 0.2
_MORE_BITS = 20  # of a record beyond the least, after which nobody sees a difference: 3 dB for each four
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 22, "lc": 0, "lp": 0, "pb": 0}]
_POSITIONS = range(3, 6)  # among the columns of a layout


def encode(model: Gaussians, table: Table) -> bytes:
    """`model` in records of a table of its SH degree."""
    model = in_morton_order(model)
    codec = Codec.fit(model, table)
    columns = codes_of_records(codec.encode(model), _layout(table))
    planes = [plane for i, each in enumerate(columns) for plane in _planes(each, _layout(table)[i][1], i)]
    packed = lzma.compress(b"".join(planes), lzma.FORMAT_RAW, filters=_FILTERS)
    return _COUNT.pack(len(model)) + codec.pack() + packed


def decode(data: bytes) -> CarriedSecret:
    """The model of `encode`. Raises InputError for damage; no more memory is taken than `data` may hold."""
    if len(data) < _COUNT.size:
        raise InputError("the hidden secret is damaged: it is too short")
    (count,) = _COUNT.unpack_from(data)
    codec = Codec.unpack(data[_COUNT.size :])
    layout = _layout(codec.table)
    size = count * sum(columns * -(-bits // 8) for columns, bits in layout)
    if not 0 < count <= MOST_GAUSSIANS:
        raise InputError(f"the hidden secret is damaged: it announces {count:,} Gaussians")
    start = _COUNT.size + Codec.packed_size(codec.table.sh_degree)
    try:
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS)
        planes = unpacker.decompress(data[start:], size + 1)
    except lzma.LZMAError as error:
        raise InputError(f"the hidden secret is damaged: {error}") from error
    if len(planes) != size or not unpacker.eof or unpacker.unused_data:
        raise InputError("the hidden secret is damaged: it is not whole")
    found, at = [], 0
    for index, (columns, bits) in enumerate(layout):
        width = columns * -(-bits // 8) * count
        part = np.frombuffer(planes, np.uint8, width, at)
        found.append(_from_planes(part.reshape(columns, -(-bits // 8), count), bits, index))
        at += width
    gaussians = codec.decode(records_of_codes(found, layout))
    return CarriedSecret(gaussians, count, codec.table.total)


def least_bytes(model: Gaussians) -> int:
    """Of the shortest encoding."""
    return len(encode(model, Table.floor(model.sh_degree)))


def fitted(model: Gaussians, room: int, *, prune: bool, short: bool = False) -> tuple[Gaussians, bytes]:
    """What of `model` is encoded, and it in at most `room` bytes, as precise as it fits, or `short`.

    If all of it does not fit, `prune` takes the most visible Gaussians, of the SH degree that renders most
    like the model. Raises UsageError without `prune`, or where nothing fits.
    """
    least = _short(model) if short else encode(model, Table.floor(model.sh_degree))
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


def _short(model: Gaussians) -> bytes:
    """The shortest encoding of which pictures are good enough, or the best of the short ones."""
    for table in Table.short(model.sh_degree):
        data = encode(model, table)
        if cost(model, decode(data).gaussians) >= _GOOD_ENOUGH:
            break
    return data


def _pruned(model: Gaussians, room: int) -> tuple[Gaussians, bytes] | None:
    """The most visible Gaussians that fit into `room` bytes; None if not even one does."""
    table, count = Table.short(model.sh_degree)[1], len(model)
    while count > 0:
        kept = most_visible(model, count)
        data = encode(kept, table)
        if len(data) <= room:
            return kept, data
        count = min(count - 1, int(0.995 * count * room / len(data)))
    return None


def _most_precise(model: Gaussians, least: bytes, room: int) -> bytes:
    """The longest encoding that fits, `least` being the shortest."""
    floor = Table.floor(model.sh_degree).total
    more = min(_MORE_BITS, 8 * (room - len(least)) // len(model))
    while more > 0:
        table = Table.of_size(floor + more, model.sh_degree)
        data = least if table is None else encode(model, table)
        if len(data) <= room:
            return data
        more -= 2
    return least


def _layout(table: Table) -> list[tuple[int, int]]:
    """(columns, bits) in the order of records: outlier, largest part; positions; ... (see `quantise`)."""
    means, log_scales, quats, opacity, *colours = table.bits
    layout = [(1, 1), (1, 2), (3, quats), (1, means), (1, means), (1, means), (3, log_scales), (1, opacity)]
    for count, bits in zip(BANDS, colours, strict=False):
        layout += [(count, bits), (2 * count, chroma_bits(bits))]
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
