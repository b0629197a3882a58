"""Elements of PLY files as structured arrays, and the Gaussians of 3DGS models among them, without torch.

The reader is our own because the usual library, plyfile, is GPL, and because input is untrusted: lengths are
checked against the file size before anything is allocated, and every defect raises InputError.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Floats, Numbers
from keyss.core.errors import InputError, KeyssWarning, not_whole
from keyss.files.inputs import open_input

_MAX_HEADER_BYTES = 64 * 1024
_CHUNK_BYTES, _TEXT_BYTES = 1 << 20, 1 << 16

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPES = {code: name for name, code in reversed(_SCALARS.items())}  # the first name of each code
_LIST = "l0"  # type code of a list property
_TEXT = "="  # byte order of an ascii file: its tables have the machine's
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": _TEXT}

# Replaces an infinite opacity logit, which converters write for opacities of 0 and 1. A larger bound would
# not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0
LEAST_LOG_SCALE = -87.33654  # log of the smallest normal float32; replaces minus infinity
NEARLY_TRANSPARENT = math.log(0.05 / 0.95)  # opacity logit
_SAMPLE = 100  # Gaussians from which on `check_not_activated` judges, and about as many that it looks at
_NEARLY_ALL = 0.99  # share of the scales
# Values that are all positive are scales, not their logarithms, if half of them are below _SMALL_SCALE, if as
# logarithms they made half of the Gaussians larger than _LARGE of the model, or if they vary by _RATIO.
_SMALL_SCALE, _LARGE, _RATIO = 0.2, 0.3, 20.0

Table = npt.NDArray[np.void]  # rows with a field for each property


@dataclass
class Vertices:
    """The vertices of an open file, read a block of rows at a time."""

    count: int
    dtype: np.dtype[np.void]  # the properties' own types
    comments: list[str]  # whole lines of the header
    blocks: Iterator[Table]  # `count` rows in total; raises InputError


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]  # name -> numpy scalar code without byte order
    order: str = _TEXT

    @property
    def dtype(self) -> np.dtype[np.void]:
        if _LIST in self.properties.values():
            raise InputError(f"element {self.name!r} has a list property: it cannot be read")
        return np.dtype([(name, self.order + code) for name, code in self.properties.items()])

    @property
    def values(self) -> int:
        return self.count * len(self.properties)

    @property
    def size(self) -> int:
        """Bytes in a binary file."""
        return self.count * self.dtype.itemsize


def read_vertices(file: BinaryIO) -> Vertices:
    """The vertices of a PLY file that is open at its start, in ascii or either byte order.

    Ignores elements and bytes after the vertices. Raises InputError for a file that is damaged or too short,
    and for list properties in or before the vertices.
    """
    elements, comments = _read_header(file)
    index = [element.name for element in elements].index("vertex")
    before, vertex = elements[:index], elements[index]
    size, values = sum(element.size for element in before), sum(element.values for element in before)
    if vertex.order == _TEXT:
        # Every value takes a digit and a separator; the file's last separator may be missing.
        _check_size(file, 2 * (values + vertex.values) - 1, vertex)
        blocks = _ascii_blocks(file, values, vertex)
    else:
        _check_size(file, size + vertex.size, vertex)
        file.seek(size, os.SEEK_CUR)
        blocks = _binary_blocks(file, vertex)
    return Vertices(vertex.count, vertex.dtype, comments, blocks)


def read_tables(file: BinaryIO) -> tuple[dict[str, Table], list[str]]:
    """All elements of a binary PLY by name, and the comments.

    Raises InputError for ascii, for list properties and for a file that is damaged or too short.
    """
    elements, comments = _read_header(file)
    if elements[0].order == _TEXT:
        raise InputError("expected a binary .ply file, found one in ascii")
    _check_size(file, sum(element.size for element in elements), elements[-1])
    tables = {}
    for element in elements:
        data = file.read(element.size)
        tables[element.name] = np.frombuffer(data, element.dtype) if data else np.empty(0, element.dtype)
    return tables, comments


def columns(table: Table, names: Sequence[str], dtype: type = np.float32) -> Numbers:
    """[N, len(names)] the values of some properties. Values beyond the range of `dtype` become infinite."""
    kinds = {kind for kind, *_ in (table.dtype.fields or {}).values()}
    if len(kinds) == 1:  # the usual case, and many times faster
        indices = [(table.dtype.names or ()).index(name) for name in names]
        return table.view(*kinds).reshape(len(table), -1).take(indices, axis=1).astype(dtype, copy=False)
    rows: Numbers = np.empty((len(table), len(names)), dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for index, name in enumerate(names):
            rows[:, index] = table[name]
    return rows


def ply_header(elements: Mapping[str, tuple[int, Iterable[str]]], comments: Iterable[str] = ()) -> bytes:
    """The header of a little-endian file, from each element's count and properties such as "float x".

    `comments`: whole lines, as in `Vertices`.
    """
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {declaration}" for declaration in properties)]
    return "\n".join([*lines, "end_header\n"]).encode("latin-1")


def _read_header(file: BinaryIO) -> tuple[list[_Element], list[str]]:
    """Elements, `vertex` among them, and comment lines. Leaves the file at the data."""
    start = file.read(_MAX_HEADER_BYTES)
    if not re.match(rb"ply\r*\n", start):
        raise InputError("expected a .ply file, but it does not begin with a line 'ply'")
    end = re.search(rb"^end_header\r*\n", start, re.MULTILINE)
    if end is None and len(start) < _MAX_HEADER_BYTES:
        raise not_whole(".ply file", "it ends inside the header")
    if end is None:
        raise InputError(f"header is longer than {_MAX_HEADER_BYTES} bytes")
    file.seek(end.end())
    formats: list[str] = []
    elements: list[_Element] = []
    comments: list[str] = []
    lines = start[: end.start()].decode("latin-1").split("\n")
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.rstrip("\r"))
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not formats:
                formats.append(_BYTE_ORDERS[name])
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", size, item, name] if elements and {size, item} <= _SCALARS.keys():
                elements[-1].properties[name] = _LIST
            case ["property", scalar, name] if (
                elements and scalar in _SCALARS and name not in elements[-1].properties
            ):
                elements[-1].properties[name] = _SCALARS[scalar]
            case _:
                raise InputError(f"cannot parse line {number} of the PLY header: {line[:80]!r}")
    names = [element.name for element in elements]
    if not formats or names.count("vertex") != 1:
        raise InputError(
            f"expected one 'format' line and one 'element vertex' in the PLY header, "
            f"got {len(formats)} and {names.count('vertex')}"
        )
    for element in elements:
        element.order = formats[0]
    return elements, comments


def _check_size(file: BinaryIO, needed: int, vertex: _Element) -> None:
    """Raise InputError if fewer than `needed` bytes follow the header."""
    start = file.tell()
    left = file.seek(0, os.SEEK_END) - start
    file.seek(start)
    if needed > left:
        raise not_whole(
            ".ply file",
            f"the header announces {vertex.count:,} vertices, which take at "
            f"least {needed:,} bytes, but only {left:,} follow it",
        )


def _binary_blocks(file: BinaryIO, vertex: _Element) -> Iterator[Table]:
    dtype = vertex.dtype
    step = max(1, _CHUNK_BYTES // dtype.itemsize)
    for start in range(0, vertex.count, step):
        size = min(step, vertex.count - start) * dtype.itemsize
        data = file.read(size)
        if len(data) != size:
            raise not_whole(".ply file", "it ends inside the data")
        yield np.frombuffer(data, dtype)


def _ascii_blocks(file: BinaryIO, skipped: int, vertex: _Element) -> Iterator[Table]:
    """Rows in text, after `skipped` values. Line breaks are white space like any other."""
    width = len(vertex.properties)
    step = max(1, _CHUNK_BYTES // (8 * width))
    tokens = _tokens(file)
    try:
        for _ in range(skipped):
            next(tokens)
        for start in range(0, vertex.count, step):
            table = np.empty(min(step, vertex.count - start), vertex.dtype)
            values = np.fromiter((float(token) for token in tokens), np.float64, count=len(table) * width)
            for name, column in zip(vertex.properties, values.reshape(len(table), width).T, strict=True):
                with np.errstate(over="ignore", invalid="ignore"):
                    table[name] = column
                if table[name].dtype.kind != "f" and not np.array_equal(table[name], column):
                    raise ValueError("not an integer of this type")
            yield table
    except (StopIteration, ValueError) as error:
        raise InputError("the ascii data are cut short or hold values of another type") from error


def _tokens(file: BinaryIO) -> Iterator[bytes]:
    """The words of a file, however long its lines are."""
    start = b""
    while chunk := file.read(_TEXT_BYTES):
        words = (start + chunk).split()
        start = words.pop() if words and not chunk[-1:].isspace() else b""
        if len(start) > _TEXT_BYTES:
            raise ValueError("a word without end")
        yield from words
    yield from start.split()


def is_plain(file: BinaryIO) -> bool:
    """True for a PLY file that is no compressed model. The position stays at the start."""
    header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0]
    file.seek(0)
    return header.startswith(b"ply") and b" packed_position" not in header


def read_rows(
    file: BinaryIO, wanted: Sequence[str] = ()
) -> tuple[Vertices, list[str], Iterator[tuple[Floats, Table]]]:
    """The vertices of a PLY file that is open at its start, `model_names`, and its Gaussians in blocks.

    A block has the values of the `wanted` names [n, len(wanted)], by default all of these names, and all
    properties [n].

    Clamps infinite opacity logits to +-OPACITY_LOGIT_BOUND and log scales of minus infinity (flat Gaussians)
    to LEAST_LOG_SCALE. Leaves out other Gaussians with NaN or infinite values, with a KeyssWarning at the
    end. Raises InputError if it is not a complete 3DGS model, or if no Gaussians remain.
    """
    vertices = read_vertices(file)
    names = model_properties(vertices.dtype.names or ())
    where = getattr(file, "name", "the model")
    return vertices, names, _finite_blocks(vertices, names, wanted, where)


def _finite_blocks(
    vertices: Vertices, names: list[str], wanted: Sequence[str], where: str
) -> Iterator[tuple[Floats, Table]]:
    kept, bad = 0, np.zeros(len(names), np.int64)
    for table in vertices.blocks:
        if wanted and _has_a_finite_sum(table):
            kept += len(table)
            yield columns(table, wanted), table
            continue
        rows = columns(table, names)
        if not np.isfinite(rows).all():
            logits, log_scales = rows[:, -8], rows[:, -7:-4]
            logits[np.isposinf(logits)] = OPACITY_LOGIT_BOUND
            logits[np.isneginf(logits)] = -OPACITY_LOGIT_BOUND
            log_scales[np.isneginf(log_scales)] = LEAST_LOG_SCALE
            finite = np.isfinite(rows)
            bad += np.count_nonzero(~finite, axis=0)
            rows, table = rows[finite.all(axis=1)], table[finite.all(axis=1)]
        kept += len(rows)
        yield rows[:, [names.index(name) for name in wanted]] if wanted else rows, table
    if not vertices.count:
        raise InputError("it holds no Gaussians")
    wrong = [f"{name} in {number:,}" for name, number in zip(names, bad, strict=True) if number]
    said = ", ".join(wrong[:5]) + (f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else "")
    if not kept:
        raise InputError(f"NaN or infinite values among {vertices.count:,} Gaussians: {said}")
    if kept < vertices.count:
        warnings.warn(
            f"{where}: {vertices.count - kept:,} of {vertices.count:,} Gaussians are left out: they have NaN "
            f"or infinite values ({said})",
            KeyssWarning,
            stacklevel=2,
        )


def _has_a_finite_sum(table: Table) -> bool:
    """True only if all values are finite, and single precision; several times as fast as to test each."""
    kinds = {kind for kind, *_ in (table.dtype.fields or {}).values()}
    if kinds != {np.dtype("<f4")}:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(table.view("<f4").sum()))


def check_not_activated(means: Floats, log_scales: Floats, opacity_logits: Floats) -> None:
    """Raise InputError if scales or opacities of a model [N, ...] are those that renderers use.

    Logits of trained models are not all within 0 to 1. Logarithms of scales are all positive in large units
    only, where they are much alike.
    """
    if len(means) < _SAMPLE:
        return
    means, log_scales = means[:: len(means) // _SAMPLE], log_scales[:: len(means) // _SAMPLE]
    spread = np.median(np.abs(means - np.median(means, axis=0)).max(axis=1))
    least, middle, most = np.quantile(log_scales, [0.05, 0.5, 0.95])
    large = middle < _SMALL_SCALE or np.exp(min(middle, 80.0)) > _LARGE * spread or most > _RATIO * least
    low, high = opacity_logits.min(), opacity_logits.max()
    activated = {
        "scales": bool((log_scales > 0).mean() > _NEARLY_ALL) and large,
        "opacities": low >= 0 and high <= 1 and high - low > 0.5,
    }
    wrong = [name for name, is_activated in activated.items() if is_activated]
    if wrong:
        raise InputError(
            f"its {' and '.join(wrong)} are those that renderers use, where a 3DGS .ply has logarithms of "
            "scales and logits of opacities: export it again without activating them, or apply log to "
            "scale_0, scale_1 and scale_2 and logit to opacity"
        )


def model_properties(present: Collection[str]) -> list[str]:
    """Names of the properties that make a model. Raises InputError if any is missing."""
    rest = {name for name in present if re.fullmatch(r"f_rest_[0-9]+", name)}
    names = model_names(len(rest) // 3 + 1)
    if len(rest) not in (0, 9, 24, 45) or not rest <= set(names):
        raise InputError(
            f"expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., got {len(rest)}: export it again "
            "with harmonics of degree 0, 1, 2 or 3"
        )
    missing = [name for name in names if name not in present]
    if missing == ["scale_2"]:
        raise InputError(
            "this is a 2DGS model: its Gaussians are flat and have no scale_2; open it in SuperSplat "
            "(superspl.at/editor) and export a .ply, which has one"
        )
    if missing[:3] == names[3:6] and {"red", "green", "blue", "opacity"} <= set(present):
        raise InputError(
            "this is a 3DGS model with colours as red, green and blue instead of harmonics (f_dc_0, ...): "
            "export it again with harmonics, from Nerfstudio with "
            "`ns-export gaussian-splat --ply-color-mode sh_coeffs`"
        )
    if missing:
        kind = "a mesh or point cloud, not a 3DGS model" if missing == names[3:] else "not a 3DGS model"
        raise InputError(f"this is {kind}: properties missing: {', '.join(missing)}")
    return names


def model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]


@dataclass(frozen=True)
class PlySummary:
    """The size of a model, and statistics of its Gaussians, which need no model in memory."""

    gaussians: int
    sh_degree: int
    low: Floats  # [3] corner of the bounding box, like `high`
    high: Floats
    nearly_transparent: int  # Gaussians with opacities below 0.05


def summarise_ply(path: Path) -> PlySummary | None:
    """The summary of a .ply, None for any other file; raises as `read_model` does."""
    if not path.is_file() or not path.name.lower().endswith(".ply"):
        return None
    with open_input(path) as file:
        if file.read(3) != b"ply":
            return None
        file.seek(0)
        return _summary(file) if is_plain(file) else None


def _summary(file: BinaryIO) -> PlySummary:
    vertices, names, blocks = read_rows(file, ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2"))
    step = max(1, vertices.count // _SAMPLE)
    low, high = np.full(7, np.inf, np.float32), np.full(7, -np.inf, np.float32)
    count, transparent, sample = 0, 0, []
    for rows, _ in blocks:
        if not len(rows):
            continue
        low, high = np.minimum(low, rows.min(axis=0)), np.maximum(high, rows.max(axis=0))
        transparent += int((rows[:, 3] < NEARLY_TRANSPARENT).sum())
        sample.append(rows[-count % step :: step].copy())
        count += len(rows)
    sampled = np.concatenate(sample)
    check_not_activated(sampled[:, :3], sampled[:, 4:], np.stack([low, high])[:, 3])
    degree = math.isqrt((len(names) - 11) // 3) - 1
    return PlySummary(count, degree, low[:3], high[:3], transparent)
