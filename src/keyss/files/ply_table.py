"""Elements of PLY files as structured arrays, for 3DGS models and point clouds.

The reader is our own because the usual library, plyfile, is GPL, and because input is untrusted: lengths are
checked against the file size before anything is allocated, and every defect raises InputError.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Numbers
from keyss.core.errors import InputError

MAX_HEADER_BYTES = 64 * 1024
_MAX_HEADER_LINES = 1000
_CHUNK_BYTES = 1 << 20
_MAX_TOKEN_BYTES = 4096  # per number in text

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPES = {code: name for name, code in reversed(_SCALARS.items())}  # the first name of each code
_LIST = "l0"  # in place of the code of a list property
_TEXT = "="  # in place of the byte order of an ascii file, whose tables have the machine's
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": _TEXT}

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
    size, values = sum(each.size for each in before), sum(each.values for each in before)
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
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header\n"]).encode("latin-1")


def _read_header(file: BinaryIO) -> tuple[list[_Element], list[str]]:
    """(elements, one of which is called vertex; comment lines). Leaves the file at the data."""
    lines = _header_lines(file)
    if lines[0] != "ply":
        raise InputError("expected a .ply file, but it does not begin with a line 'ply'")
    formats: list[str] = []
    elements: list[_Element] = []
    comments: list[str] = []
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line)
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


def _header_lines(file: BinaryIO) -> list[str]:
    """The header's lines without their ends, up to end_header; only the first if that is not `ply`."""
    lines: list[str] = []
    left = MAX_HEADER_BYTES
    while left > 0 and len(lines) < _MAX_HEADER_LINES:
        raw = file.readline(left)
        left -= len(raw)
        if not raw.endswith(b"\n") and left > 0:
            raise InputError("not a whole .ply file: it ends inside the header")
        line = raw.rstrip(b"\r\n").decode("latin-1")
        if line == "end_header" and lines:
            return lines
        lines.append(line)
        if lines[0] != "ply":
            return lines
    raise InputError(f"header is longer than {MAX_HEADER_BYTES} bytes or {_MAX_HEADER_LINES} lines")


def _check_size(file: BinaryIO, needed: int, vertex: _Element) -> None:
    """Raise InputError if fewer than `needed` bytes follow the header."""
    start = file.tell()
    left = file.seek(0, os.SEEK_END) - start
    file.seek(start)
    if needed > left:
        raise InputError(
            f"not a whole .ply file: the header announces {vertex.count:,} vertices, which take at "
            f"least {needed:,} bytes, but only {left:,} follow it"
        )


def _binary_blocks(file: BinaryIO, vertex: _Element) -> Iterator[Table]:
    dtype = vertex.dtype
    step = max(1, _CHUNK_BYTES // dtype.itemsize)
    for start in range(0, vertex.count, step):
        size = min(step, vertex.count - start) * dtype.itemsize
        data = file.read(size)
        if len(data) != size:
            raise InputError("not a whole .ply file: it ends inside the data")
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
    """Tokens separated by white space, in lines of any length. Raises ValueError for very long ones."""
    rest = b""
    while data := file.read(_CHUNK_BYTES):
        *whole, rest = re.split(rb"[ \t\r\n\f\v]+", rest + data)
        yield from filter(None, whole)
        if len(rest) > _MAX_TOKEN_BYTES:
            raise ValueError("not a number")
    if rest:
        yield rest
