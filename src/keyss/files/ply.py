"""Reader and writer of 3DGS models in the Inria PLY layout.

One vertex is one Gaussian: x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3,
raw parameters as `Gaussians` holds them; f_rest is channel-major (all red coefficients, then green,
then blue). The reader is our own because models come from strangers and the part of PLY that 3DGS
uses is small: every length is checked against the file's size before anything is allocated, and
whatever is wrong comes out as InputError. (The usual library, plyfile, is GPL besides.)
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
import torch

from keyss.core import Gaussians, InputError, OutputError
from keyss.files.atomic import atomic_write

# Stands in for an infinite opacity logit. Converters write infinities for opacities of 0 and 1; a larger
# bound would not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0

_MAX_HEADER_BYTES = 64 * 1024
_MAX_HEADER_LINES = 1000
_CHUNK_BYTES = 1 << 20

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}

_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]


@dataclass(frozen=True)
class PlyInfo:
    """What a person asks first about a 3DGS model on disk."""

    count: int
    sh_degree: int  # 0 to 3
    bytes: int  # size of the file
    lower: tuple[float, float, float]  # smallest x, y, z of the means
    upper: tuple[float, float, float]  # largest x, y, z of the means
    faint_share: float  # share of the Gaussians with opacity below 0.05, in [0, 1]


def describe_ply(path: Path | str) -> PlyInfo:
    """Read the model at `path` and sum it up. Raises InputError as `read_ply` does."""
    gaussians = read_ply(path)
    lower, upper = gaussians.means.amin(0).tolist(), gaussians.means.amax(0).tolist()
    return PlyInfo(
        count=len(gaussians),
        sh_degree=gaussians.sh_degree,
        bytes=Path(path).stat().st_size,
        lower=(lower[0], lower[1], lower[2]),
        upper=(upper[0], upper[1], upper[2]),
        faint_share=float((gaussians.opacities < 0.05).float().mean()),
    )


def write_ply(path: Path | str, gaussians: Gaussians) -> None:
    """Atomically write `gaussians` to `path` as little-endian float32 in the Inria layout.

    Normals are zeros, infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the
    values only. Raises OutputError when there are no Gaussians, when a value is not finite, or when the
    system refuses.
    """
    n, k = gaussians.sh.shape[:2]
    names = [*_MEANS, *_NORMALS, *_DC, *_rest_names(k), "opacity", *_SCALES, *_QUATS]
    flat = gaussians.detach().to("cpu")
    rows = np.concatenate(
        [
            flat.means.numpy(),
            np.zeros((n, 3)),
            flat.sh[:, 0].numpy(),
            flat.sh[:, 1:].transpose(1, 2).reshape(n, 3 * (k - 1)).numpy(),
            flat.opacity_logits[:, None].numpy(),
            flat.log_scales.numpy(),
            flat.quats.numpy(),
        ],
        axis=1,
        dtype="<f4",
    )
    problem = _settle(rows, names)
    if problem:
        raise OutputError(f"cannot write {path}: {problem}")
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n"
    with atomic_write(path) as file:
        file.write(header.encode("ascii"))
        file.write(rows.data)


def read_ply(path: Path | str) -> Gaussians:
    """Read a 3DGS model: float32 tensors on the CPU, SH of the file's own degree.

    Properties are found by name, in any order and of any scalar type; normals, unknown properties,
    comments, other elements and bytes after the data are ignored. Infinite opacity logits become
    +-OPACITY_LOGIT_BOUND. Raises InputError for anything that is not a whole, finite 3DGS model in
    binary or ascii PLY.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: expected a 3DGS .ply file, but there is no such file")
    try:
        with path.open("rb") as file:
            header = _read_header(file, path)
            names = _model_properties(header.vertex, path)
            rows = _read_rows(file, header, names, path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    problem = _settle(rows, names)
    if problem:
        raise InputError(f"{path}: {problem}")
    return _gaussians(rows)


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


@dataclass(frozen=True)
class _Header:
    byte_order: str | None  # "<", ">" or None for ascii
    before: list[_Element]  # elements whose data precede the vertices
    vertex: _Element


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Parse up to and including end_header; the file is then at the first byte of the data."""
    lines = _header_lines(file, path)
    if lines[0] != "ply":
        raise InputError(f"{path}: expected a .ply file, but it does not begin with a line 'ply'")
    byte_order: str | None = None
    format_seen = False
    elements: list[_Element] = []
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not format_seen:
                byte_order, format_seen = _BYTE_ORDERS[name], True
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
    positions = [i for i, element in enumerate(elements) if element.name == "vertex"]
    if not format_seen or len(positions) != 1:
        raise InputError(
            f"{path}: expected one 'format' line and one 'element vertex' in the PLY header, "
            f"got {int(format_seen)} and {len(positions)}"
        )
    before, vertex = elements[: positions[0]], elements[positions[0]]
    for element in [*before, vertex]:
        if element.has_list:
            raise InputError(f"{path}: element {element.name!r} has a list property, which no 3DGS model has")
    return _Header(byte_order, before, vertex)


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    """The header's lines without their ends, end_header left out."""
    lines: list[str] = []
    left = _MAX_HEADER_BYTES
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
    raise InputError(
        f"{path}: the PLY header is longer than {_MAX_HEADER_BYTES} bytes or {_MAX_HEADER_LINES} lines"
    )


def _model_properties(vertex: _Element, path: Path) -> list[str]:
    """Names of the properties that make a `Gaussians`, in its order. Raises InputError if any is missing."""
    found = vertex.properties.keys()
    rest = {name for name in found if re.fullmatch(r"f_rest_[0-9]+", name)}
    k = len(rest) // 3 + 1
    if len(rest) not in (0, 9, 24, 45) or rest != set(_rest_names(k)):
        raise InputError(
            f"{path}: expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ... (SH degree 0 to 3), "
            f"got {len(rest)}"
        )
    names = [*_MEANS, *_QUATS, *_SCALES, "opacity", *_DC, *_rest_names(k)]
    missing = [name for name in names if name not in found]
    if not missing:
        return names
    if "packed_position" in found:
        why = "this is a compressed .ply; convert it to a plain 3DGS .ply first (splat-transform does)"
    elif missing == names[3:]:
        why = "this is a point cloud, not a 3DGS model"
    else:
        why = "this is not a 3DGS model"
    raise InputError(f"{path}: {why}: properties missing: {', '.join(missing)}")


def _read_rows(file: BinaryIO, header: _Header, names: list[str], path: Path) -> npt.NDArray[np.float32]:
    """[N, len(names)] values of the vertices. Raises InputError when the file is too short for them."""
    vertex = header.vertex
    left = os.fstat(file.fileno()).st_size - file.tell()
    if header.byte_order is None:
        # Every value takes a digit and a separator; the file's last separator may be missing.
        skipped = sum(element.count * len(element.properties) for element in header.before)
        needed = 2 * (skipped + vertex.count * len(vertex.properties)) - 1
    else:
        skipped = sum(element.count * element.stride for element in header.before)
        needed = skipped + vertex.count * vertex.stride
    if needed > left:
        raise InputError(
            f"{path}: not a whole .ply file: the header announces {vertex.count:,} Gaussians, which take at "
            f"least {needed:,} bytes, but only {left:,} follow it"
        )
    if header.byte_order is None:
        return _read_ascii(file, skipped, vertex, names, path)
    file.seek(skipped, os.SEEK_CUR)
    return _read_binary(file, header.byte_order, vertex, names, path)


def _read_binary(
    file: BinaryIO, byte_order: str, vertex: _Element, names: list[str], path: Path
) -> npt.NDArray[np.float32]:
    offsets: dict[str, int] = {}
    stride = 0
    for name, code in vertex.properties.items():
        offsets[name] = stride
        stride += int(code[1])
    dtype = np.dtype(
        {
            "names": names,
            "formats": [byte_order + vertex.properties[name] for name in names],
            "offsets": [offsets[name] for name in names],
            "itemsize": stride,
        }
    )
    rows = np.empty((vertex.count, len(names)), dtype=np.float32)
    step = max(1, _CHUNK_BYTES // stride)
    for start in range(0, vertex.count, step):
        part = rows[start : start + step]
        data = file.read(len(part) * stride)
        if len(data) != len(part) * stride:
            raise InputError(f"{path}: not a whole .ply file: it ends inside the data")
        chunk = np.frombuffer(data, dtype=dtype)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows float32 is reported as infinite
            for column, name in enumerate(names):
                part[:, column] = chunk[name]
    return rows


def _read_ascii(
    file: BinaryIO, skipped: int, vertex: _Element, names: list[str], path: Path
) -> npt.NDArray[np.float32]:
    """The same from text, after `skipped` values. Only the order of the values matters, not the lines."""
    width = len(vertex.properties)
    tokens = (token for line in file for token in line.split())
    try:
        for _ in range(skipped):
            next(tokens)
        values = np.fromiter((float(token) for token in tokens), dtype=np.float64, count=vertex.count * width)
    except (StopIteration, ValueError) as error:
        raise InputError(f"{path}: the ascii data are cut short or hold something not a number") from error
    order = {name: column for column, name in enumerate(vertex.properties)}
    with np.errstate(over="ignore"):
        return values.reshape(vertex.count, width)[:, [order[name] for name in names]].astype(np.float32)


def _settle(rows: npt.NDArray[np.float32], names: list[str]) -> str | None:
    """Clamp infinite opacity logits in place; say what is still wrong with the values, if anything."""
    if len(rows) == 0:
        return "it holds no Gaussians"
    opacity = rows[:, names.index("opacity")]
    opacity[np.isposinf(opacity)] = OPACITY_LOGIT_BOUND
    opacity[np.isneginf(opacity)] = -OPACITY_LOGIT_BOUND
    bad = np.count_nonzero(~np.isfinite(rows), axis=0)
    wrong = [f"{name} in {count:,}" for name, count in zip(names, bad, strict=True) if count]
    if not wrong:
        return None
    more = f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else ""
    return f"NaN or infinite values among {len(rows):,} Gaussians: {', '.join(wrong[:5])}{more}"


def _gaussians(rows: npt.NDArray[np.float32]) -> Gaussians:
    """`Gaussians` of rows whose columns are in the order of `_model_properties`."""
    values = torch.from_numpy(rows)
    n = len(values)
    rest = values[:, 14:].reshape(n, 3, -1).transpose(1, 2)  # [N, K - 1, 3]
    return Gaussians(
        means=values[:, 0:3].contiguous(),
        quats=values[:, 3:7].contiguous(),
        log_scales=values[:, 7:10].contiguous(),
        opacity_logits=values[:, 10].contiguous(),
        sh=torch.cat([values[:, None, 11:14], rest], dim=1),
    )


def _rest_names(k: int) -> list[str]:
    """Names of the SH coefficients above the constant one, for `k` basis functions."""
    return [f"f_rest_{i}" for i in range(3 * (k - 1))]
