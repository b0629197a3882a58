"""The vertices of a PLY file as a table of numbers: the basis of 3DGS models and of point clouds.

The reader is our own because files come from strangers and the part of PLY in use is small: every length
is compared with the file's size before anything is allocated, and every defect raises InputError. (The usual
library, plyfile, is GPL.)
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Numbers
from keyss.core.errors import InputError
from keyss.files.reading import open_input

if TYPE_CHECKING:
    from keyss.files.layout import PointCloud


MAX_HEADER_BYTES = 64 * 1024
_MAX_HEADER_LINES = 1000
_CHUNK_BYTES = 1 << 20
_MAX_TOKEN_BYTES = 4096  # of one number in text
_GREY = 128  # of points without colours

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPES = {code: name for name, code in reversed(_SCALARS.items())}  # the first name of each code
_LIST = "l0"  # in place of the code of a list property
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}


@dataclass
class Vertices:
    """Some properties of all vertices, read from the file a block of rows at a time."""

    names: list[str]
    count: int
    blocks: Iterator[Numbers]  # [n, len(names)] each; `count` rows at most; they may be changed
    dtype: type  # of the rows

    def rows(self) -> Numbers:
        """[n, len(names)] all rows."""
        rows: Numbers = np.empty((self.count, len(self.names)), self.dtype)
        start = 0
        for block in self.blocks:
            rows[start : start + len(block)] = block
            start += len(block)
        return rows[:start]


@dataclass
class VertexTable:
    """All properties of all vertices, read from the file a block of rows at a time."""

    names: list[str]
    count: int
    blocks: Iterator[npt.NDArray[np.void]]  # structured arrays, `count` rows in total
    comments: list[str]  # lines of the header


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]  # name -> numpy scalar code without byte order

    @property
    def stride(self) -> int:
        """Bytes of one row in a binary file."""
        return sum(int(code[1]) for code in self.properties.values())


def read_vertices(
    file: BinaryIO, choose: Callable[[dict[str, str]], list[str]], dtype: type = np.float32
) -> Vertices:
    """The vertex properties that `choose` picks, from an open PLY file.

    `choose` gets the numpy codes of all scalar vertex properties by name ("f4", "u1", ...) and returns
    names among them; it may raise InputError. Reads ascii and both binary byte orders; comments, other
    elements and bytes after the data are ignored. Raises InputError for a file that is damaged or too short,
    and for list properties in or before the vertices; so do the blocks.
    """
    byte_order, before, vertex, _ = _vertex_header(file)
    names = choose(vertex.properties)
    columns = [list(vertex.properties).index(name) for name in names]
    _check_vertices(file, byte_order, before, vertex)
    if byte_order is None:
        return Vertices(names, vertex.count, _ascii_blocks(file, before, vertex, columns, dtype), dtype)
    _skip(file, before)
    return Vertices(names, vertex.count, _binary_blocks(file, byte_order, vertex, columns, dtype), dtype)


def read_vertex_table(file: BinaryIO) -> VertexTable:
    """All vertices with the properties' own types. Raises InputError as `read_vertices` does."""
    byte_order, before, vertex, comments = _vertex_header(file)
    _check_vertices(file, byte_order, before, vertex)
    dtype = np.dtype([(name, (byte_order or "=") + code) for name, code in vertex.properties.items()])
    if byte_order is None:
        rows = _ascii_blocks(file, before, vertex, list(range(len(vertex.properties))), np.float64)
        blocks = (_typed(block, dtype) for block in rows)
    else:
        _skip(file, before)
        blocks = (np.frombuffer(data, dtype) for data in _binary_rows(file, vertex))
    return VertexTable(list(vertex.properties), vertex.count, blocks, comments)


def _typed(rows: Numbers, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
    table = np.empty(len(rows), dtype)
    for name, values in zip(dtype.names or (), rows.T, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            table[name] = values
    return table


def _vertex_header(file: BinaryIO) -> tuple[str | None, list[_Element], _Element, list[str]]:
    """(byte order or None for ascii, elements before the vertices, the vertices, lines of comments)."""
    byte_order, elements, comments = _read_header(file)
    index = [element.name for element in elements].index("vertex")
    before, vertex = elements[:index], elements[index]
    _check_no_list([*before, vertex])
    return byte_order, before, vertex, comments


def _check_vertices(file: BinaryIO, byte_order: str | None, before: list[_Element], vertex: _Element) -> None:
    """Raise InputError if what follows the header is too short for the vertices."""
    parts = [*before, vertex]
    if byte_order is None:
        # Every value takes a digit and a separator; the file's last separator may be missing.
        _check_size(file, 2 * sum(each.count * len(each.properties) for each in parts) - 1, vertex)
    else:
        _check_size(file, sum(each.count * each.stride for each in parts), vertex)


def _skip(file: BinaryIO, before: list[_Element]) -> None:
    """Move to the vertices of a binary file."""
    file.seek(sum(element.count * element.stride for element in before), os.SEEK_CUR)


def read_tables(file: BinaryIO) -> dict[str, npt.NDArray[np.void]]:
    """All elements of a binary PLY by name, as structured arrays with the properties' own types.

    Raises InputError for ascii, for list properties and for a file that is damaged or too short.
    """
    byte_order, elements, _ = _read_header(file)
    if byte_order is None:
        raise InputError("expected a binary .ply file, found one in ascii")
    _check_no_list(elements)
    _check_size(file, sum(element.count * element.stride for element in elements), elements[-1])
    tables = {}
    for element in elements:
        dtype = np.dtype([(name, byte_order + code) for name, code in element.properties.items()])
        data = file.read(element.count * element.stride)
        tables[element.name] = np.frombuffer(data, dtype) if element.stride else np.empty(0, dtype)
    return tables


def ply_header(elements: Mapping[str, tuple[int, Iterable[str]]], comments: Iterable[str] = ()) -> bytes:
    """The header of a little-endian file, from each element's count and properties such as "float x".

    `comments`: whole lines, as in a `VertexTable`.
    """
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header\n"]).encode("latin-1")


def read_point_cloud(path: Path) -> PointCloud:
    """The points of a PLY with `x y z` and, optionally, `red green blue` (uchar), else grey.

    Raises InputError if the file is not such a PLY, is truncated or holds coordinates that are not finite.
    """
    from keyss.files.layout import PointCloud  # imports the lens code, which models do not need

    def choose(properties: dict[str, str]) -> list[str]:
        if missing := {"x", "y", "z"} - properties.keys():
            raise InputError(f"expected vertices with x, y and z, found no {sorted(missing)}")
        colors = {name: properties[name] for name in ("red", "green", "blue") if name in properties}
        if list(colors.values()) not in ([], ["u1"] * 3):
            raise InputError(f"expected red, green and blue of type uchar, found {colors}")
        return ["x", "y", "z", *colors]

    with open_input(path) as file:
        rows = read_vertices(file, choose, np.float64).rows()
    colors = rows[:, 3:] if rows.shape[1] > 3 else np.full((len(rows), 3), _GREY)
    if not ((colors >= 0) & (colors <= 255)).all():  # possible in ascii
        raise InputError(f"{path}: expected colours of 0 to 255, found others")
    return PointCloud.checked(path, rows[:, :3], colors.astype(np.uint8))


def _read_header(file: BinaryIO) -> tuple[str | None, list[_Element], list[str]]:
    """(byte order or None for ascii, the elements, lines of comments); the data come next.

    One element is the vertices.
    """
    lines = _header_lines(file)
    if lines[0] != "ply":
        raise InputError("expected a .ply file, but it does not begin with a line 'ply'")
    formats: list[str | None] = []
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
    return formats[0], elements, comments


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


def _check_no_list(elements: Iterable[_Element]) -> None:
    for element in elements:
        if _LIST in element.properties.values():
            raise InputError(f"element {element.name!r} has a list property: it cannot be read")


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


def _binary_blocks(
    file: BinaryIO, byte_order: str, vertex: _Element, columns: list[int], into: type
) -> Iterator[Numbers]:
    dtype = np.dtype([(name, byte_order + code) for name, code in vertex.properties.items()])
    is_float32 = set(vertex.properties.values()) == {"f4"}
    names = [list(vertex.properties)[column] for column in columns]
    for data in _binary_rows(file, vertex):
        count = len(data) // vertex.stride
        if is_float32:
            table = np.frombuffer(data, byte_order + "f4").reshape(count, -1)
            yield table.take(columns, axis=1).astype(into, copy=False)
            continue
        table = np.frombuffer(data, dtype=dtype)
        rows: Numbers = np.empty((count, len(names)), into)
        with np.errstate(over="ignore", invalid="ignore"):  # float32 overflow is reported as infinite
            for column, name in enumerate(names):
                rows[:, column] = table[name]
        yield rows


def _binary_rows(file: BinaryIO, vertex: _Element) -> Iterator[bytes]:
    """Whole rows, about _CHUNK_BYTES at a time."""
    step = max(1, _CHUNK_BYTES // max(1, vertex.stride))
    for start in range(0, vertex.count, step):
        size = min(step, vertex.count - start) * vertex.stride
        data = file.read(size)
        if len(data) != size:
            raise InputError("not a whole .ply file: it ends inside the data")
        yield data


def _ascii_blocks(
    file: BinaryIO, before: list[_Element], vertex: _Element, columns: list[int], into: type
) -> Iterator[Numbers]:
    """Rows in text, after other elements. Only the order of the values matters, not the lines."""
    width = len(vertex.properties)
    skipped = sum(element.count * len(element.properties) for element in before)
    step = max(1, _CHUNK_BYTES // (8 * max(1, width)))
    tokens = _tokens(file)
    try:
        for _ in range(skipped):
            next(tokens)
        for start in range(0, vertex.count, step):
            count = min(step, vertex.count - start) * width
            values = np.fromiter((float(token) for token in tokens), dtype=np.float64, count=count)
            with np.errstate(over="ignore"):
                yield values.reshape(-1, width)[:, columns].astype(into)
    except (StopIteration, ValueError) as error:
        raise InputError("the ascii data are cut short or hold something not a number") from error


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
