"""glTF's binary form, .glb, with the extension KHR_gaussian_splatting.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting. Attributes are
activated: scales and opacities, not their logarithms and logits. glTF has y up; like other converters, we
rotate a .ply by 180 degrees about z. Written files have this rotation in their node, and unchanged positions.

Reads the subset of glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html) that Gaussians need;
Python libraries for glTF do not decode buffers or check bounds.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from keyss.core.arrays import Doubles, Numbers
from keyss.core.errors import InputError, damaged, not_whole
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.file_kinds import FIT
from keyss.files.formats.common import (
    arrays_of,
    assembled,
    blocks_of,
    colour_bytes,
    gaussians_of,
    log_scales_of,
    reason,
    scales_of,
    to_bytes,
    unit,
    writable,
)

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TURN = (0.0, 0.0, 1.0, 0.0)  # 180 degrees about z, xyzw
_MAX_JSON_BYTES = 1 << 20  # parsed, JSON takes up to 80 times as much memory
_MAX_DEPTH = 64  # nested nodes
_MAX_PARTS = 64  # primitives with Gaussians, each counted once per node
_VALUES_PER_BYTE = 4  # maximum; accessors that share bytes, and nodes that share a mesh, exceed it


_Natural = Annotated[int, msgspec.Meta(ge=0)]


class _Accessor(msgspec.Struct, omit_defaults=True):
    """Typed values in a buffer view."""

    count: _Natural
    type: str
    componentType: int
    bufferView: _Natural = 1 << 32  # a missing one: values that are all 0 are no Gaussians
    byteOffset: _Natural = 0
    normalized: bool = False
    min: list[float] = []
    max: list[float] = []
    sparse: dict[str, Any] | None = None


class _BufferView(msgspec.Struct, omit_defaults=True):
    buffer: int
    byteOffset: _Natural = 0
    byteLength: _Natural = 0
    byteStride: int | None = None
    target: int | None = None


class _Node(msgspec.Struct, omit_defaults=True):
    mesh: _Natural | None = None
    children: list[_Natural] = []
    matrix: list[float] | None = None
    translation: list[float] | None = None
    rotation: list[float] | None = None
    scale: list[float] | None = None


class _Primitive(msgspec.Struct, omit_defaults=True):
    attributes: dict[str, _Natural] = {}  # indices of accessors
    mode: int = 4
    extensions: dict[str, dict[str, Any]] = {}


class _Mesh(msgspec.Struct):
    primitives: list[_Primitive]


class _Scene(msgspec.Struct):
    nodes: list[_Natural] = []


class _Document(msgspec.Struct, omit_defaults=True):
    """The part of a glTF document used here."""

    asset: dict[str, Any] = {}
    extensionsUsed: list[str] = []
    scene: _Natural | None = None
    scenes: list[_Scene] = []
    nodes: list[_Node] = []
    buffers: list[dict[str, Any]] = []
    bufferViews: list[_BufferView] = []
    accessors: list[_Accessor] = []
    meshes: list[_Mesh] = []


def read(data: bytes) -> Gaussians:
    """All Gaussians of a file's scene, as one model in the frame of a .ply.

    Raises InputError, also for files without Gaussians or with compressed ones.
    """
    document, binary = _chunks(data)
    parts = [
        (to_scene, _attributes(document, primitive, binary)) for to_scene, primitive in _instances(document)
    ]
    if not parts:
        _refuse_compressed(name for name in document.extensionsUsed if "spz" in name.lower())
        raise InputError(
            f"a glTF file without Gaussians, such as a mesh: nothing in its scene has {EXTENSION}; {FIT}"
        )
    count = sum(len(attributes) for _, attributes in parts)
    degree = max(attributes.sh_degree for _, attributes in parts)
    if count * (11 + 3 * (degree + 1) ** 2) > _VALUES_PER_BYTE * len(data):
        raise damaged("glTF", "the same Gaussians over and over")
    blocks = (
        move(attributes.gaussians(part)).with_sh_degree(degree)
        for to_scene, attributes in parts
        for move in [_to_ply_frame(to_scene)]
        for part in blocks_of(len(attributes))
    )
    return assembled(count, blocks, drop=True)


def write(model: Gaussians) -> bytes:
    """A model as a file, with vertex colours for programs that show it as points."""
    means, quats, log_scales, alphas, f_dc, rest = arrays_of(writable(model))
    colors = np.concatenate([colour_bytes(f_dc), to_bytes(alphas * 255)[:, None]], axis=1)
    attributes = {
        "POSITION": means,
        "COLOR_0": colors,
        f"{EXTENSION}:ROTATION": np.roll(quats, -1, axis=1),
        f"{EXTENSION}:SCALE": scales_of(log_scales),
        f"{EXTENSION}:OPACITY": alphas,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": f_dc,
    }
    names = _coefficients(model.sh_degree)
    attributes |= {name: rest[:, index] for index, name in enumerate(names[1:])}
    views: list[_BufferView] = []
    accessors: list[_Accessor] = []
    binary = bytearray()
    for name, array in attributes.items():
        is_color = name == "COLOR_0"
        content = array if is_color else array.astype("<f4")
        views.append(_BufferView(0, len(binary), content.nbytes, target=_ARRAY_BUFFER))
        kind = "SCALAR" if content.ndim == 1 else f"VEC{content.shape[1]}"
        component = _BYTE if is_color else _FLOAT
        accessors.append(_Accessor(len(content), kind, component, len(accessors), normalized=is_color))
        binary += content.tobytes()
    accessors[0].min, accessors[0].max = means.min(axis=0).tolist(), means.max(axis=0).tolist()
    settings = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    indices = {name: index for index, name in enumerate(attributes)}
    document = _Document(
        asset={"version": "2.0", "generator": "keyss"},
        extensionsUsed=[EXTENSION],
        scene=0,
        scenes=[_Scene([0])],
        nodes=[_Node(mesh=0, rotation=list(_TURN))],
        buffers=[{"byteLength": len(binary)}],
        bufferViews=views,
        accessors=accessors,
        meshes=[_Mesh([_Primitive(indices, _POINTS, {EXTENSION: settings})])],
    )
    text = msgspec.json.encode(document)
    text += b" " * (-len(text) % 4)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)
    start = _HEADER.pack(_MAGIC, 2, size) + _CHUNK.pack(len(text), _JSON) + text
    return start + _CHUNK.pack(len(binary), _BIN) + bytes(binary)


def _refuse_compressed(extensions: Iterable[str]) -> None:
    """Raise InputError if there are `extensions`, which compress Gaussians."""
    if names := ", ".join(extensions)[:80]:
        raise InputError(
            f"its Gaussians are compressed ({names}), which keyss does not read in a glTF file; export a "
            ".ply or .spz from the program that made it"
        )


def _chunks(data: bytes) -> tuple[_Document, memoryview]:
    """The JSON and the binary chunk of a file."""
    if len(data) < _HEADER.size or not data.startswith(_MAGIC):
        raise InputError("not a .glb: it does not begin with glTF")
    _, version, size = _HEADER.unpack_from(data)
    if version != 2:
        raise InputError(f"expected version 2 of glTF, found version {version}")
    if size > len(data):
        raise not_whole(".glb", f"expected {size:,} bytes, found {len(data):,}")
    chunks: list[memoryview] = []
    at = _HEADER.size
    for kind in (_JSON, _BIN):
        start = at + _CHUNK.size
        length, name = _CHUNK.unpack_from(data, at) if start <= len(data) else (0, b"")
        at = start + length
        if name != kind or at > len(data):
            raise not_whole(".glb", "a chunk is missing, cut short, or out of place")
        chunks.append(memoryview(data)[start:at])
    if len(chunks[0]) > _MAX_JSON_BYTES:
        raise InputError(f"expected JSON of at most {_MAX_JSON_BYTES:,} bytes, found {len(chunks[0]):,}")
    try:
        return msgspec.json.decode(chunks[0], type=_Document), chunks[1]
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"cannot parse the JSON of the .glb: {reason(error)}") from error


def _instances(document: _Document) -> Iterator[tuple[Doubles, _Primitive]]:
    """The primitives of Gaussians in the scene, each with its transform [4, 4] to the scene's coordinates."""
    splats = [
        [primitive for primitive in mesh.primitives if EXTENSION in primitive.extensions]
        for mesh in document.meshes
    ]
    try:
        roots: Sequence[int] = range(len(document.nodes))
        if document.scenes:
            roots = document.scenes[document.scene or 0].nodes
        # Nodes with those above them, which transform only what has Gaussians.
        stack: list[tuple[int, tuple[_Node, ...]]] = [(index, ()) for index in roots]
        visited: set[int] = set()
        left = _MAX_PARTS
        while stack:
            index, above = stack.pop()
            if index in visited or len(above) > _MAX_DEPTH:
                raise damaged("glTF", "its nodes are not a tree")
            visited.add(index)
            node = document.nodes[index]
            path = (*above, node)
            stack += [(child, path) for child in node.children]
            primitives = [] if node.mesh is None else splats[node.mesh]
            left -= len(primitives)
            if left < 0:
                raise InputError(
                    f"expected at most {_MAX_PARTS} groups of Gaussians in a glTF file, found more"
                )
            if primitives:
                to_scene = reduce(np.matmul, map(_transform, path))
                yield from ((to_scene, primitive) for primitive in primitives)
    except IndexError as error:
        raise damaged("glTF", "it refers to a missing part") from error


def _transform(node: _Node) -> Doubles:
    """[4, 4] from a node's coordinates to its parent's."""
    transform = np.eye(4)
    try:
        if node.matrix is not None:
            transform = np.array(node.matrix, np.float64).reshape(4, 4).T
        elif node.rotation or node.scale or node.translation:  # Rotation is slow
            rotation = Rotation.from_quat(node.rotation or [0, 0, 0, 1]).as_matrix()
            transform[:3, :3] = rotation * np.array(node.scale or [1, 1, 1], np.float64).reshape(3)
            transform[:3, 3] = node.translation or [0, 0, 0]
    except ValueError as error:
        raise damaged("glTF", "a node has no proper transform") from error
    if not np.isfinite(transform).all():
        raise damaged("glTF", "a node's transform is not finite")
    return transform


@dataclass(frozen=True)
class _Values:
    """The values [N, width] of an accessor, which stay in the file until they are taken."""

    stored: Numbers
    normalized: bool  # integers stand for shares of the largest

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, part: slice) -> Numbers:
        values = self.stored[part]
        if values.dtype.kind == "f":
            return values.astype(np.float32)
        numbers = values.astype(np.float64)
        return np.maximum(numbers / np.iinfo(values.dtype).max, -1.0) if self.normalized else numbers


@dataclass(frozen=True)
class _Attributes:
    """The attributes of a primitive's Gaussians, in its own coordinates."""

    means: _Values
    quats: _Values  # xyzw
    scales: _Values
    alphas: _Values
    sh: list[_Values]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(len(self.sh)) - 1

    def gaussians(self, part: slice) -> Gaussians:
        """Some of the Gaussians. Raises InputError for opacities out of range."""
        alphas, sh = self.alphas[part][:, 0], [band[part] for band in self.sh]
        if ((alphas < 0) | (alphas > 1)).any():
            raise damaged("glTF", "opacities outside of 0 to 1")
        quats = unit(np.roll(self.quats[part], 1, axis=1))
        rest = np.stack(sh[1:], axis=1) if len(sh) > 1 else np.empty((len(alphas), 0, 3))
        return gaussians_of(self.means[part], quats, log_scales_of(self.scales[part]), alphas, sh[0], rest)


def _attributes(document: _Document, primitive: _Primitive, binary: memoryview) -> _Attributes:
    """The attributes of a primitive. Raises InputError."""
    compressed = primitive.extensions[EXTENSION].get("extensions", {})
    _refuse_compressed(compressed if isinstance(compressed, dict) else ["unknown"])

    def attribute(name: str, width: int) -> _Values:
        if name not in primitive.attributes:
            raise damaged("glTF", f"its Gaussians have no {name}")
        return _values(document, primitive.attributes[name], width, binary)

    degree = max(d for d in range(4) if d == 0 or f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in primitive.attributes)
    attributes = _Attributes(
        means=attribute("POSITION", 3),
        quats=attribute(f"{EXTENSION}:ROTATION", 4),
        scales=attribute(f"{EXTENSION}:SCALE", 3),
        alphas=attribute(f"{EXTENSION}:OPACITY", 1),
        sh=[attribute(name, 3) for name in _coefficients(degree)],
    )
    others = (attributes.quats, attributes.scales, attributes.alphas, *attributes.sh)
    if not len(attributes) or any(len(column) != len(attributes) for column in others):
        raise damaged("glTF", "no Gaussians, or attributes of different lengths")
    return attributes


def _values(document: _Document, index: int, width: int, binary: memoryview) -> _Values:
    """The values [N, width] of an accessor into the binary chunk."""
    try:
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
    except IndexError as error:
        raise damaged("glTF", "it refers to a missing part") from error
    code = _COMPONENTS.get(accessor.componentType)
    if accessor.sparse is not None or code is None or _WIDTHS.get(accessor.type) != width:
        raise damaged("glTF", f"expected an accessor of {width} numbers each")
    if view.buffer != 0 or any("uri" in buffer for buffer in document.buffers[:1]):
        raise InputError("expected a .glb that contains its data, found one that refers to other files")
    dtype = np.dtype(code)
    row = width * dtype.itemsize
    stride = view.byteStride or row
    start, end = view.byteOffset + accessor.byteOffset, view.byteOffset + view.byteLength
    needed = (accessor.count - 1) * stride + row
    if stride < row or (accessor.count and start + needed > min(end, len(binary))):
        raise damaged("glTF", "an accessor exceeds its buffer view")
    shape, strides = (accessor.count, width), (stride, dtype.itemsize)
    stored = np.ndarray(shape, dtype, binary, start, strides) if accessor.count else np.empty(shape)
    return _Values(stored, accessor.normalized)


def _to_ply_frame(to_scene: Doubles) -> Callable[[Gaussians], Gaussians]:
    """Transforms Gaussians by `to_scene` to a scene with y up, then to the frame of a .ply."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_quat(_TURN).as_matrix().round()
    whole = turn @ to_scene
    if np.array_equal(whole, np.eye(4)):
        return lambda model: model
    with np.errstate(all="ignore"):
        scale = abs(float(np.linalg.det(whole[:3, :3]))) ** (1 / 3)
    try:
        if not math.isfinite(scale) or scale <= 0:
            raise ValueError("no scale")
        rotation, translation = torch.from_numpy(whole[:3, :3] / scale), torch.from_numpy(whole[:3, 3].copy())
        return Similarity(scale, rotation, translation).apply_gaussians
    except ValueError as error:
        raise InputError("a glTF node transforms Gaussians by more than a similarity") from error


def _coefficients(degree: int) -> list[str]:
    """Attribute names of harmonics, in order."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)]
