"""Ordinary point clouds in PLY files: positions and colours, nothing of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from keyss.core.errors import InputError
from keyss.files.layout import Points
from keyss.files.reading import read_file

_MAX_HEADER_BYTES = 64 * 1024
_TYPES = {
    alias: kind
    for kind, aliases in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for alias in aliases.split()
}
_GREY = 128  # for points without colours


def read_point_cloud(path: Path) -> Points:
    """The `x y z` and, where there are any, `red green blue` (uchar) of a PLY's vertices.

    Reads ascii and both binary byte orders. The vertices must be the first element and have no lists;
    whatever follows them is ignored. Raises InputError when the file is no such PLY, is truncated or
    holds coordinates that are not finite.
    """
    data = read_file(path)
    order, count, properties, start = _header(path, data)
    missing = {"x", "y", "z"} - {name for name, _ in properties}
    if missing:
        raise InputError(
            f"{path}: expected vertices with x, y and z, found none of {', '.join(sorted(missing))}"
        )
    colored = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    has_colors = all(color in properties for color in colored)
    if any(name == "red" for name, _ in properties) and not has_colors:
        raise InputError(f"{path}: expected red, green and blue of type uchar, found {dict(properties)}")
    if order == "a":
        columns = _ascii(path, data[start:], count, properties)
    else:
        vertices = np.dtype([(name, order + kind) for name, kind in properties])
        if count * vertices.itemsize > len(data) - start:
            raise InputError(
                f"{path}: expected {count} vertices of {vertices.itemsize} bytes, "
                f"but only {len(data) - start} bytes are left: the file is truncated or damaged"
            )
        rows = np.frombuffer(data, vertices, count, start)
        columns = {name: rows[name].astype(np.float64) for name, _ in properties}
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=1)
    rgb = np.full((count, 3), _GREY, dtype=np.uint8)
    if has_colors:
        values = np.stack([columns[name] for name, _ in colored], axis=1)
        if not ((values >= 0) & (values <= 255)).all():
            raise InputError(f"{path}: expected colours of 0 to 255, found others")
        rgb = values.astype(np.uint8)
    return Points.checked(path, xyz, rgb)


def _header(path: Path, data: bytes) -> tuple[str, int, list[tuple[str, str]], int]:
    """(byte order or "a" for ascii, number of vertices, their (name, type), where the body starts)."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    body = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or body == 0:
        raise InputError(f"{path}: expected a PLY file with a header of up to {_MAX_HEADER_BYTES} bytes")
    order, count = "", -1
    properties: list[tuple[str, str]] = []
    elements = 0
    for line in data[:end].decode("latin-1").splitlines():
        match line.split():
            case ["format", kind, _]:
                order = {"ascii": "a", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind, "")
            case ["element", name, number]:
                elements += 1
                if elements == 1 and name == "vertex" and number.isascii() and number.isdigit():
                    count = int(number[:18])
            case ["property", kind, name] if elements == 1 and kind in _TYPES:
                properties.append((name, _TYPES[kind]))
            case ["property", *_] if elements == 1:
                raise InputError(f"{path}: expected scalar vertex properties, found {line[:80]!r}")
    if not order or count < 0 or len(dict(properties)) != len(properties):
        raise InputError(f"{path}: expected a PLY header with a format and the vertices as first element")
    return order, count, properties, body


def _ascii(
    path: Path, body: bytes, count: int, properties: list[tuple[str, str]]
) -> dict[str, NDArray[np.float64]]:
    width = len(properties)
    words = body.split(maxsplit=min(count * width, len(body)))[: count * width]
    if len(words) < count * width:
        raise InputError(
            f"{path}: expected {count} vertices of {width} numbers, found {len(words)}: it is truncated"
        )
    try:
        table = np.array(words, dtype=np.float64).reshape(count, width)
    except ValueError as error:
        raise InputError(f"{path}: expected vertices as numbers: {error}") from error
    return {name: table[:, i] for i, (name, _) in enumerate(properties)}
