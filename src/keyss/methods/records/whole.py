"""A model as one string of bytes, for channels that carry all of it or nothing.

    number of Gaussians (4 bytes), SH degree (1), step of harmonics (4), codec (see `quantise`),
    columns of codes, compressed by zstd

Gaussians are sorted along a Z-order curve, which keeps the differences between neighbouring positions small.
Everything except the harmonics above degree 0 is coded as in records. Those harmonics are mostly close to
zero: they are converted to brightness and two colour differences, divided by a step and rounded.

An error in a Gaussian's harmonics costs more the more of a picture the Gaussian covers. The step therefore
shrinks by a quarter of an octave for each octave by which area times opacity squared exceeds the median.
(Equal errors in a picture would need half an octave, but small Gaussians are seen from nearer; a quarter
measured best.) Both sides compute it from the other numbers. Gaussians with equal steps are stored together
because they compress better.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import zstandard

from keyss.core.arrays import Bytes, Doubles, Integers, Words32
from keyss.core.errors import InputError
from keyss.core.gaussians import OPPONENT, Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.records.lines import Table
from keyss.methods.records.quantise import Codec, outliers

_ALWAYS = 1 << 16  # Gaussians that any payload may announce
_MIN_BYTES = 2  # of each Gaussian in larger models
USUAL_BITS, MAX_BITS = 110, 143  # of all but harmonics: about 48 and 60 dB
_HEAD = struct.Struct("<IBf")
_STEP, _HALVED = 0.06, 20  # of harmonics at the usual bits; with so many more bits it is half as large
_LARGEST = 127  # code of a harmonic
_PER_OCTAVE = 0.5 / math.log(2)  # half octaves of the step
_FINER = 6  # half octaves by which a step may be finer or coarser
_WINDOW_LOG = 22
_OWN_BLOCK = 256  # bytes of a plane that begins a block of its own
# The header of every frame, which is not stored: no size, no checksum, and this window.
_FRAME = bytes.fromhex("28b52ffd00") + bytes([(_WINDOW_LOG - 10) << 3])
_POSITIONS = range(3, 6)  # among the columns of a layout


class Precision(NamedTuple):
    """The table and the step that a model is encoded with."""

    table: Table  # of SH degree 0
    step: float  # of harmonics, below 1

    @staticmethod
    def of_size(bits: int) -> Precision:
        """At most `bits` per Gaussian, harmonics and compression not counted; USUAL_BITS to MAX_BITS."""
        table = Table.of_size(bits, 0, Table.short())
        if table is None:
            raise ValueError(f"expected at least {Table.short().total} bits, got {bits}")
        return Precision(table, _STEP * 2 ** ((USUAL_BITS - bits) / _HALVED))


def encode(model: Gaussians, precision: Precision | None = None) -> bytes:
    """`model` as bytes, by default with the usual precision."""
    table, step = precision or Precision.of_size(USUAL_BITS)
    step = float(np.float32(step))
    model = in_morton_order(model)
    plain = model.with_sh_degree(0)
    codec = Codec.fit(plain, table)
    columns = codec.codes(plain, outliers(plain))
    planes: list[bytes] = []
    for index, (codes, (_, bits)) in enumerate(zip(columns, table.layout, strict=True)):
        planes += _planes(codes, bits, index)
    planes += _harmonics(model, codec.gaussians(columns), step)
    return _HEAD.pack(len(model), model.sh_degree, step) + codec.pack() + _compress(planes)


def decode(data: bytes, carriers: int | None = None) -> Gaussians:
    """The model of `encode`, read from a model of `carriers` Gaussians. Raises InputError for damage.

    Memory is bounded: above 2^16 Gaussians, each takes at least 2 bytes of `data`, and there are no more than
    `carriers`.
    """
    if len(data) < _HEAD.size:
        raise InputError("the hidden secret is damaged: it is too short")
    count, sh_degree, step = _HEAD.unpack_from(data)
    codec = Codec.unpack(data[_HEAD.size :])
    if not (count > 0 and sh_degree <= 3 and codec.table.sh_degree == 0 and 0 < step < 1):
        raise InputError(
            f"the hidden secret is damaged: it announces {count:,} Gaussians of SH degree {sh_degree}"
        )
    largest = len(data) // _MIN_BYTES
    if count > max(_ALWAYS, largest if carriers is None else min(largest, carriers)):
        held_by = f"{len(data):,} bytes" + ("" if carriers is None else f" in {carriers:,} Gaussians")
        raise InputError(
            f"the hidden secret is damaged: it announces {count:,} Gaussians, more than {held_by} hold"
        )
    layout, harmonics = codec.table.layout, 3 * ((sh_degree + 1) ** 2 - 1)
    own = count * sum(columns * -(-bits // 8) for columns, bits in layout)
    planes = _decompress(data[_HEAD.size + Codec.packed_size(0) :], own + count * harmonics)
    found, at = [], 0
    for index, (columns, bits) in enumerate(layout):
        width = columns * -(-bits // 8) * count
        part = np.frombuffer(planes, np.uint8, width, at)
        found.append(_from_planes(part.reshape(columns, -1, count), bits, index))
        at += width
    plain = codec.gaussians(found)
    codes = np.frombuffer(planes, np.int8, offset=own).reshape(harmonics // 3, 3, count)
    numbers = _from_harmonics(codes, plain, step)
    return replace(plain, sh=torch.cat([plain.sh, numbers], 1))


def _compress(planes: Sequence[bytes]) -> bytes:
    """The blocks of a zstd frame. Statistics of planes differ: large ones get blocks of their own."""
    parameters = zstandard.ZstdCompressionParameters.from_level(
        19, window_log=_WINDOW_LOG, min_match=6, write_content_size=False
    )
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    parts = []
    for plane in planes:
        parts.append(compressor.compress(plane))
        if len(plane) >= _OWN_BLOCK:
            parts.append(compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
    frame = b"".join([*parts, compressor.flush()])
    if not frame.startswith(_FRAME):
        raise RuntimeError("this version of zstandard writes another frame header")
    return frame[len(_FRAME) :]


def _decompress(blocks: bytes, size: int) -> bytes:
    """The `size` bytes of `_compress`. Raises InputError for damage and for any other size."""
    try:
        found: bytes = zstandard.ZstdDecompressor(max_window_size=1 << _WINDOW_LOG).decompress(
            _FRAME + blocks, max_output_size=size, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise InputError(f"the hidden secret is damaged: {error}") from error
    if len(found) != size:
        raise InputError("the hidden secret is damaged: it is not whole")
    return found


def _harmonics(model: Gaussians, plain: Gaussians, step: float) -> list[bytes]:
    """Codes of brightness and two differences for each coefficient above degree 0, a byte per Gaussian.

    `plain`: the decoded model of degree 0.
    """
    numbers = model.sh[:, 1:].detach().cpu().numpy().astype(np.float64) @ OPPONENT.T
    finer = _finer(plain)
    codes = np.rint(numbers / _steps(step, finer)[:, None, None]).clip(-_LARGEST, _LARGEST)
    columns = codes[np.argsort(finer, kind="stable")].astype(np.int8).reshape(len(model), -1).T
    return [column.tobytes() for column in columns]


def _from_harmonics(codes: npt.NDArray[np.int8], plain: Gaussians, step: float) -> torch.Tensor:
    """[N, coefficients, 3] harmonics of the codes [coefficients, 3, N]; the inverse of `_harmonics`."""
    finer = _finer(plain)
    steps = _steps(step, finer)[np.argsort(finer, kind="stable")]
    # One product and one sum after the other: every reader gets the same float32 numbers.
    parts = codes * steps
    rows = np.empty((len(plain), len(codes), 3), np.float32)
    for channel in range(3):
        sums = parts[:, 0] * OPPONENT[0, channel]
        for row in (1, 2):
            sums = sums + parts[:, row] * OPPONENT[row, channel]
        rows[np.argsort(finer, kind="stable"), :, channel] = sums.T
    return torch.from_numpy(rows)


def _finer(plain: Gaussians) -> Integers:
    """[N] half octaves by which each Gaussian's steps are finer than those of the median one."""
    scales = np.sort(plain.log_scales.numpy().astype(np.float64), axis=1)
    logits = plain.opacity_logits.numpy().astype(np.float64)
    seen = scales[:, 2] + scales[:, 1] + 2 * np.minimum(logits, 0)  # nearly the logarithm of the opacity
    middle = np.sort(seen)[(len(seen) - 1) // 2]
    found: Integers = np.floor((seen - middle) * _PER_OCTAVE + 0.5).astype(np.int64)
    return found.clip(-_FINER, _FINER)


def _steps(step: float, finer: Integers) -> Doubles:
    """[N] steps, exact products of `step`, a power of two and the square root of two or one."""
    steps: Doubles = step * np.where(finer % 2, math.sqrt(2), 1.0) * 2.0 ** -((finer + 1) // 2)
    return steps


def _planes(codes: Words32, bits: int, index: int) -> Sequence[bytes]:
    """The lowest bytes of each column of codes [N, C], then the higher ones; differences of positions."""
    if index in _POSITIONS:
        codes = codes.copy()
        codes[1:] -= codes[:-1].copy()
        codes &= np.uint32((1 << bits) - 1)
    shifts = range(0, bits, 8)
    return [(column >> np.uint32(shift)).astype(np.uint8).tobytes() for column in codes.T for shift in shifts]


def _from_planes(planes: Bytes, bits: int, index: int) -> Words32:
    """[N, C] codes from planes [C, bytes, N]; the inverse of `_planes`."""
    codes = np.zeros((planes.shape[2], planes.shape[0]), np.uint32)
    for plane in range(planes.shape[1]):
        codes |= planes[:, plane].T.astype(np.uint32) << np.uint32(8 * plane)
    if index in _POSITIONS:
        codes = np.cumsum(codes, axis=0, dtype=np.uint32)
    return codes & np.uint32((1 << bits) - 1)
