"""The vertices of any PLY file as a table of numbers, which 3DGS models are made of, and as a point cloud.

The reader is our own because files come from strangers and the part of PLY in use is small: every length
is checked against the file's size before anything is allocated, and whatever is wrong comes out as
InputError. (The usual library, plyfile, is GPL besides.)
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

from keyss.core.errors import InputError
from keyss.files.streams import StandardInput

if TYPE_CHECKING:
    from keyss.files.layout import PointCloud

Rows = npt.NDArray[np.float32]

MAX_HEADER_BYTES = 64 * 1024
_MAX_HEADER_LINES = 1000
_CHUNK_BYTES = 1 << 20
_MAX_TOKEN_BYTES = 4096  # of one number in text
_GREY = 128  # for points without colours

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}


def read_vertices(
    path: Path | str | StandardInput, choose: Callable[[dict[str, str]], list[str]]
) -> tuple[list[str], Rows]:
    """The vertex properties that `choose` picks, and their values [N, len(names)] in that order.

    See `read_vertex_blocks`.
    """
    whole = WholeTable()
    return read_vertex_blocks(path, choose, whole.begin), whole.rows


class WholeTable:
    """What takes all vertices of `read_vertex_blocks`."""

    def begin(self, names: list[str], count: int) -> Callable[[int, Rows], None]:
        self.rows = np.empty((count, len(names)), np.float32)
        return self._place

    def _place(self, start: int, rows: Rows) -> None:
        self.rows[start : start + len(rows)] = rows


def read_vertex_blocks(
    path: Path | str | StandardInput,
    choose: Callable[[dict[str, str]], list[str]],
    begin: Callable[[list[str], int], Callable[[int, Rows], None]],
) -> list[str]:
    """Read the vertex properties that `choose` picks, some vertices at a time; the names of these.

    `choose` gets the numpy codes of all scalar vertex properties by name ("f4", "u1", ...) and returns
    names among them; it may raise InputError. `begin` gets the names and the number of vertices, and returns
    what takes the values [n, len(names)] of the vertices from a number on; it may keep and change them. Reads
    ascii and both binary byte orders; comments, other elements and bytes after the data are ignored. Raises
    InputError for a file that is missing, damaged or too short, and for list properties up to the vertices.
    """
    path = Path(path) if isinstance(path, str) else path
    if not path.is_file():
        raise InputError(f"{path}: expected a .ply file, but there is no such file")
    try:
        with path.open("rb") as file:
            byte_order, elements = _read_header(file, path)
            *before, vertex = elements[: [each.name for each in elements].index("vertex") + 1]
            _check_no_list([*before, vertex], path)
            names = choose(vertex.properties)
            parts = _blocks(file, byte_order, before, vertex, names, path)
            place, start = begin(names, vertex.count), 0
            for rows in parts:
                place(start, rows)
                start += len(rows)
            return names
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_tables(file: BinaryIO, path: Path | StandardInput) -> dict[str, npt.NDArray[np.void]]:
    """All elements of a binary PLY, by name, with the properties as fields of their own types.

    Raises InputError for ascii, for list properties and for a file that is damaged or too short.
    """
    byte_order, elements = _read_header(file, path)
    if byte_order is None:
        raise InputError(f"{path}: expected a binary .ply file, found one in ascii")
    _check_no_list(elements, path)
    start = file.tell()
    left = file.seek(0, os.SEEK_END) - start
    file.seek(start)
    _check_size(sum(element.count * element.stride for element in elements), left, elements[-1], path)
    tables = {}
    for element in elements:
        dtype = np.dtype([(name, byte_order + code) for name, code in element.properties.items()])
        data = file.read(element.count * element.stride)
        tables[element.name] = np.frombuffer(data, dtype) if element.stride else np.empty(0, dtype)
    return tables


def ply_header(elements: Mapping[str, tuple[int, Iterable[str]]]) -> bytes:
    """The header of a little-endian file of elements: how many, and properties such as "float x"."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header\n"]).encode()


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]  # name -> numpy scalar code without byte order
    has_list: bool = False

    @property
    def stride(self) -> int:
        """Bytes of one row in a binary file."""
        return sum(int(code[1]) for code in self.properties.values())


def _read_header(file: BinaryIO, path: Path | StandardInput) -> tuple[str | None, list[_Element]]:
    """(byte order or None for ascii, the elements, one of them the vertices); the data come next."""
    lines = _header_lines(file, path)
    if lines[0] != "ply":
        raise InputError(f"{path}: expected a .ply file, but it does not begin with a line 'ply'")
    formats: list[str | None] = []
    elements: list[_Element] = []
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not formats:
                formats.append(_BYTE_ORDERS[name])
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", size, item, _] if elements and {size, item} <= _SCALARS.keys():
                elements[-1].has_list = True
            case ["property", scalar, name] if (
                elements and scalar in _SCALARS and name not in elements[-1].properties
            ):
                elements[-1].properties[name] = _SCALARS[scalar]
            case _:
                raise InputError(f"{path}: line {number} of the PLY header makes no sense: {line[:80]!r}")
    names = [element.name for element in elements]
    if not formats or names.count("vertex") != 1:
        raise InputError(
            f"{path}: expected one 'format' line and one 'element vertex' in the PLY header, "
            f"got {len(formats)} and {names.count('vertex')}"
        )
    return formats[0], elements


def _check_no_list(elements: Iterable[_Element], path: Path | StandardInput) -> None:
    for element in elements:
        if element.has_list:
            raise InputError(f"{path}: element {element.name!r} has a list property: it cannot be read")


def _check_size(needed: int, left: int, vertex: _Element, path: Path | StandardInput) -> None:
    if needed > left:
        raise InputError(
            f"{path}: not a whole .ply file: the header announces {vertex.count:,} vertices, which take at "
            f"least {needed:,} bytes, but only {left:,} follow it"
        )


def _header_lines(file: BinaryIO, path: Path | StandardInput) -> list[str]:
    """The header's lines without their ends, end_header left out."""
    lines: list[str] = []
    left = MAX_HEADER_BYTES
    while left > 0 and len(lines) < _MAX_HEADER_LINES:
        raw = file.readline(left)
        left -= len(raw)
        if not raw.endswith(b"\n") and left > 0:
            raise InputError(f"{path}: not a whole .ply file: it ends inside the header")
        line = raw.rstrip(b"\r\n").decode("latin-1")
        if line == "end_header" and lines:
            return lines
        lines.append(line)
        if lines[0] != "ply":
            return lines
    raise InputError(f"{path}: header is longer than {MAX_HEADER_BYTES} bytes or {_MAX_HEADER_LINES} lines")


def _blocks(
    file: BinaryIO,
    byte_order: str | None,
    before: list[_Element],
    vertex: _Element,
    names: list[str],
    path: Path | StandardInput,
) -> Iterator[Rows]:
    """[n, len(names)] values of some vertices at a time. Raises InputError when the file is too short."""
    start = file.tell()
    left = file.seek(0, os.SEEK_END) - start
    file.seek(start)
    if byte_order is None:
        # Every value takes a digit and a separator; the file's last separator may be missing.
        skipped = sum(element.count * len(element.properties) for element in before)
        needed = 2 * (skipped + vertex.count * len(vertex.properties)) - 1
    else:
        skipped = sum(element.count * element.stride for element in before)
        needed = skipped + vertex.count * vertex.stride
    _check_size(needed, left, vertex, path)
    if byte_order is None:
        return _ascii_blocks(file, skipped, vertex, names, path)
    file.seek(skipped, os.SEEK_CUR)
    return _binary_blocks(file, byte_order, vertex, names, path)


def _binary_blocks(
    file: BinaryIO, byte_order: str, vertex: _Element, names: list[str], path: Path | StandardInput
) -> Iterator[Rows]:
    dtype = np.dtype([(name, byte_order + code) for name, code in vertex.properties.items()])
    plain = set(vertex.properties.values()) == {"f4"}
    columns = [list(vertex.properties).index(name) for name in names]
    step = max(1, _CHUNK_BYTES // max(1, vertex.stride))
    for start in range(0, vertex.count, step):
        count = min(step, vertex.count - start)
        data = file.read(count * vertex.stride)
        if len(data) != count * vertex.stride:
            raise InputError(f"{path}: not a whole .ply file: it ends inside the data")
        if plain:
            table = np.frombuffer(data, byte_order + "f4").reshape(count, -1)
            yield table.take(columns, axis=1).astype(np.float32, copy=False)
            continue
        chunk, rows = np.frombuffer(data, dtype=dtype), np.empty((count, len(names)), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows float32 is reported as infinite
            for column, name in enumerate(names):
                rows[:, column] = chunk[name]
        yield rows


def _ascii_blocks(
    file: BinaryIO, skipped: int, vertex: _Element, names: list[str], path: Path | StandardInput
) -> Iterator[Rows]:
    """The values in text, after `skipped` values. Only the order of the values matters, not the lines."""
    width = len(vertex.properties)
    columns = [list(vertex.properties).index(name) for name in names]
    step = max(1, _CHUNK_BYTES // (8 * max(1, width)))
    tokens = _tokens(file)
    try:
        for _ in range(skipped):
            next(tokens)
        for start in range(0, vertex.count, step):
            count = min(step, vertex.count - start) * width
            values = np.fromiter((float(token) for token in tokens), dtype=np.float64, count=count)
            with np.errstate(over="ignore"):
                yield values.reshape(-1, width)[:, columns].astype(np.float32)
    except (StopIteration, ValueError) as error:
        raise InputError(f"{path}: the ascii data are cut short or hold something not a number") from error


def _tokens(file: BinaryIO) -> Iterator[bytes]:
    """What white space separates, however long the lines are; ValueError for what is longer than a number."""
    rest = b""
    while data := file.read(_CHUNK_BYTES):
        *whole, rest = re.split(rb"[ \t\r\n\f\v]+", rest + data)
        yield from filter(None, whole)
        if len(rest) > _MAX_TOKEN_BYTES:
            raise ValueError("not a number")
    if rest:
        yield rest


def read_point_cloud(path: Path) -> PointCloud:
    """The `x y z` and, where there are any, `red green blue` (uchar) of a PLY's vertices.

    Raises InputError when the file is no such PLY, is truncated or holds coordinates that are not finite.
    """

    from keyss.files.layout import PointCloud  # with what undoes lenses, which models need not

    def choose(found: dict[str, str]) -> list[str]:
        missing = {"x", "y", "z"} - found.keys()
        if missing:
            raise InputError(f"{path}: expected vertices with x, y and z, found no {sorted(missing)}")
        colors = {name: found[name] for name in ("red", "green", "blue") if name in found}
        if list(colors.values()) not in ([], ["u1"] * 3):
            raise InputError(f"{path}: expected red, green and blue of type uchar, found {colors}")
        return ["x", "y", "z", *colors]

    names, rows = read_vertices(path, choose)
    colors = rows[:, 3:] if len(names) > 3 else np.full((len(rows), 3), _GREY)
    if not ((colors >= 0) & (colors <= 255)).all():  # possible in ascii
        raise InputError(f"{path}: expected colours of 0 to 255, found others")
    return PointCloud.checked(path, rows[:, :3].astype(np.float64), colors.astype(np.uint8))
