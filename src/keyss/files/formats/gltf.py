"""The part of glTF 2.0 that Gaussians need: documents, nodes and accessors, from strangers.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Libraries of Python for glTF leave to their users
what lies in a buffer, and check no bounds.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from keyss.core.errors import InputError
from keyss.files.formats.common import Doubles

EXTENSION = "KHR_gaussian_splatting"
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Accessor(msgspec.Struct, omit_defaults=True):
    """Typed values in a buffer view."""

    count: int
    type: str
    componentType: int
    bufferView: int | None = None
    byteOffset: int = 0
    normalized: bool = False
    min: list[float] = []
    max: list[float] = []
    sparse: dict[str, Any] | None = None


class BufferView(msgspec.Struct, omit_defaults=True):
    """Bytes of a buffer."""

    buffer: int
    byteOffset: int = 0
    byteLength: int = 0
    byteStride: int | None = None
    target: int | None = None


class Node(msgspec.Struct, omit_defaults=True):
    """A place in the scene."""

    mesh: int | None = None
    children: list[int] = []
    matrix: list[float] | None = None
    translation: list[float] | None = None
    rotation: list[float] | None = None
    scale: list[float] | None = None

    def transform(self) -> Doubles:
        """[4, 4] to the coordinates of the node above. Raises InputError."""
        found = np.eye(4)
        try:
            if self.matrix is not None:
                found = np.array(self.matrix, np.float64).reshape(4, 4).T
            else:
                turn = Rotation.from_quat(self.rotation or [0, 0, 0, 1]).as_matrix()
                found[:3, :3] = turn * np.array(self.scale or [1, 1, 1], np.float64).reshape(3)
                found[:3, 3] = self.translation or [0, 0, 0]
        except ValueError as error:
            raise InputError("damaged glTF: a node has no proper transform") from error
        if not np.isfinite(found).all():
            raise InputError("damaged glTF: a node's transform is not finite")
        return found


class Primitive(msgspec.Struct, omit_defaults=True):
    """What is drawn: indices of accessors by name of the attribute."""

    attributes: dict[str, int] = {}
    mode: int = 4
    extensions: dict[str, dict[str, Any]] = {}


class Mesh(msgspec.Struct):
    """Primitives."""

    primitives: list[Primitive]


class Document(msgspec.Struct, omit_defaults=True):
    """A glTF document; what it has besides is left out."""

    asset: dict[str, Any] = {}
    extensionsUsed: list[str] = []
    scene: int | None = None
    scenes: list[dict[str, Any]] = []
    nodes: list[Node] = []
    buffers: list[dict[str, Any]] = []
    bufferViews: list[BufferView] = []
    accessors: list[Accessor] = []
    meshes: list[Mesh] = []


def values(document: Document, index: int, width: int, binary: bytes) -> Doubles:
    """[N, width] the values of an accessor into the binary part of a file. Raises InputError."""
    if not 0 <= index < len(document.accessors):
        raise InputError("damaged glTF: it names an accessor that is not there")
    accessor = document.accessors[index]
    view_index = -1 if accessor.bufferView is None else accessor.bufferView
    code = _COMPONENTS.get(accessor.componentType)
    if accessor.sparse is not None or code is None or _WIDTHS.get(accessor.type) != width:
        raise InputError(f"damaged glTF: expected an accessor of {width} numbers each")
    if not 0 <= view_index < len(document.bufferViews):
        raise InputError("damaged glTF: it names a buffer view that is not there")
    view = document.bufferViews[view_index]
    if view.buffer != 0 or any("uri" in each for each in document.buffers[:1]):
        raise InputError("keyss reads glTF whose data lie in the .glb itself, and these lie elsewhere")
    dtype = np.dtype(code)
    row = width * dtype.itemsize
    stride = view.byteStride or row
    start, end = view.byteOffset + accessor.byteOffset, view.byteOffset + view.byteLength
    needed = (accessor.count - 1) * stride + row
    whole = min(accessor.count, view.byteOffset, accessor.byteOffset) >= 0 and stride >= row
    if not whole or (accessor.count and start + needed > min(end, len(binary))):
        raise InputError("damaged glTF: an accessor leads out of its data")
    if accessor.count == 0:
        return np.empty((0, width))
    found = np.ndarray((accessor.count, width), dtype, binary, start, (stride, dtype.itemsize))
    numbers = found.astype(np.float64)
    if accessor.normalized and dtype.kind != "f":
        numbers = np.maximum(numbers / np.iinfo(dtype).max, -1.0)
    return numbers
