"""glTF's binary form, .glb, with the extension KHR_gaussian_splatting.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting. Attributes are
activated: scales and opacities, not their logarithms and logits. glTF has y up; as other converters do, the
frame of a .ply is taken for one turned by 180 degrees about z. What we write says so in its node, and keeps
the values.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

import msgspec
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.formats.common import (
    Doubles,
    arrays_of,
    colour_bytes,
    gaussians_of,
    log_scales_of,
    logits,
    opacities,
    reason,
    scales_of,
    to_bytes,
    unit,
)
from keyss.files.formats.gltf import EXTENSION, Accessor, BufferView, Document, Mesh, Node, Primitive, values

_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_FLOAT, _BYTE, _ARRAY = 5126, 5121, 34962
_TURN = (0.0, 0.0, 1.0, 0.0)  # 180 degrees about z, xyzw
_COUNTS = (1, 3, 5, 7)  # coefficients of each degree
_MAX_DEPTH = 64  # of nodes in nodes
_MAX_PARTS = 64  # that show Gaussians
_MIN_BYTES = 16  # that a Gaussian takes


def read_glb(data: bytes) -> Gaussians:
    """All Gaussians of a file's scene, as one model in the frame of a .ply.

    Raises InputError for a file without any, and for those that another extension compresses.
    """
    document, binary = _chunks(data)
    parts: list[Gaussians] = []
    room = len(data) // _MIN_BYTES  # Gaussians; one that is shown twice counts twice
    for placed, mesh in _placed(document):
        for primitive in mesh.primitives:
            if EXTENSION not in primitive.extensions:
                continue
            model = _gaussians(document, primitive, binary)
            room -= len(model)
            if room < 0 or len(parts) == _MAX_PARTS:
                raise InputError("damaged glTF: the same Gaussians over and over")
            parts.append(_moved(model, placed))
    if not parts:
        raise InputError(f"a glTF file without Gaussians: nothing in its scene has {EXTENSION}")
    degree = max(part.sh_degree for part in parts)
    return Gaussians.cat([part.with_sh_degree(degree) for part in parts])


def write_glb(model: Gaussians) -> bytes:
    """A model as a file, with colours for programs that know points only."""
    means, quats, log_scales, opacity_logits, f_dc, rest = arrays_of(model)
    alphas = opacities(opacity_logits)
    rgba = np.concatenate([colour_bytes(f_dc), to_bytes(alphas * 255)[:, None]], axis=1)
    attributes = {
        "POSITION": means,
        "COLOR_0": rgba,
        f"{EXTENSION}:ROTATION": np.roll(unit(quats), -1, axis=1),
        f"{EXTENSION}:SCALE": scales_of(log_scales),
        f"{EXTENSION}:OPACITY": alphas,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": f_dc,
    }
    names = _coefficients(model.sh_degree)
    attributes |= {name: rest[:, index] for index, name in enumerate(names[1:])}
    document = Document(
        asset={"version": "2.0", "generator": "keyss"},
        extensionsUsed=[EXTENSION],
        scene=0,
        scenes=[{"nodes": [0]}],
        nodes=[Node(mesh=0, rotation=list(_TURN))],
    )
    binary = bytearray()
    for array in attributes.values():
        content = array if array.dtype == np.uint8 else array.astype("<f4")
        kind = {1: "SCALAR"}.get(content.ndim, f"VEC{content.shape[-1]}")
        document.bufferViews.append(BufferView(0, len(binary), content.nbytes, target=_ARRAY))
        accessor = Accessor(
            len(content), kind, _FLOAT if array is not rgba else _BYTE, len(document.accessors)
        )
        accessor.normalized = array is rgba
        if array is means:
            accessor.min, accessor.max = means.min(axis=0).tolist(), means.max(axis=0).tolist()
        document.accessors.append(accessor)
        binary += content.tobytes()
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    settings |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
    document.meshes = [
        Mesh([Primitive({name: i for i, name in enumerate(attributes)}, 0, {EXTENSION: settings})])
    ]
    document.buffers = [{"byteLength": len(binary)}]
    text = msgspec.json.encode(document)
    text += b" " * (-len(text) % 4)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)
    start = _HEADER.pack(_MAGIC, 2, size) + _CHUNK.pack(len(text), _JSON) + text
    return start + _CHUNK.pack(len(binary), _BIN) + bytes(binary)


def _chunks(data: bytes) -> tuple[Document, bytes]:
    """The JSON and the binary part of a file."""
    if len(data) < _HEADER.size or not data.startswith(_MAGIC):
        raise InputError("not a .glb: it does not begin with glTF")
    _, version, size = _HEADER.unpack_from(data)
    if version != 2 or size > len(data):
        raise InputError("not a whole .glb of glTF 2.0")
    found: list[bytes] = []
    at = _HEADER.size
    for kind in (_JSON, _BIN):
        if at + _CHUNK.size > len(data):
            raise InputError("not a whole .glb: a part is missing")
        length, name = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size
        if name != kind or at + length > len(data):
            raise InputError("not a whole .glb: a part is missing, cut short, or out of place")
        found.append(data[at : at + length])
        at += length
    try:
        return msgspec.json.decode(found[0], type=Document), found[1]
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"the JSON of the .glb makes no sense: {reason(error)}") from error


def _placed(document: Document) -> Iterable[tuple[Doubles, Mesh]]:
    """The meshes of the scene, each with the transform [4, 4] from its coordinates to the scene's."""
    try:
        roots = (
            document.scenes[document.scene or 0].get("nodes", [])
            if document.scenes
            else range(len(document.nodes))
        )
        left = [(index, np.eye(4), 0) for index in roots if isinstance(index, int)]
        seen: set[int] = set()
        while left:
            index, above, depth = left.pop()
            if index in seen or depth > _MAX_DEPTH or index < 0:
                raise InputError("damaged glTF: its nodes are no tree")
            seen.add(index)
            node = document.nodes[index]
            here = above @ node.transform()
            left += [(child, here, depth + 1) for child in node.children]
            if node.mesh is not None:
                yield here, document.meshes[node.mesh]
    except (IndexError, TypeError) as error:
        raise InputError("damaged glTF: it names a part that is not there") from error


def _gaussians(document: Document, primitive: Primitive, binary: bytes) -> Gaussians:
    """The Gaussians of a primitive, in its own coordinates."""
    if "extensions" in primitive.extensions[EXTENSION]:
        raise InputError(
            "its Gaussians are compressed by another extension of glTF, which keyss does not read"
        )

    def attribute(name: str, width: int) -> Doubles:
        if name not in primitive.attributes:
            raise InputError(f"damaged glTF: its Gaussians have no {name}")
        return values(document, primitive.attributes[name], width, binary)

    degree = max(d for d in range(4) if d == 0 or f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in primitive.attributes)
    sh = [attribute(name, 3) for name in _coefficients(degree)]
    means = attribute("POSITION", 3)
    quats = attribute(f"{EXTENSION}:ROTATION", 4)
    scales = attribute(f"{EXTENSION}:SCALE", 3)
    alphas = attribute(f"{EXTENSION}:OPACITY", 1)[:, 0]
    if not len(means) or any(len(each) != len(means) for each in (quats, scales, alphas, *sh)):
        raise InputError("damaged glTF: no Gaussians, or attributes of different lengths")
    if not ((alphas >= 0) & (alphas <= 1)).all():
        raise InputError("damaged glTF: opacities outside of 0 to 1")
    rest = np.stack(sh[1:], axis=1) if degree else np.empty((len(means), 0, 3))
    wxyz = unit(np.roll(quats, 1, axis=1))
    return gaussians_of(means, wxyz, log_scales_of(scales), logits(alphas), sh[0], rest)


def _moved(model: Gaussians, placed: Doubles) -> Gaussians:
    """`model` from coordinates that `placed` takes to a scene with y up, to those of a .ply."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_quat(_TURN).as_matrix().round()
    whole = turn @ placed
    if np.array_equal(whole, np.eye(4)):
        return model
    with np.errstate(all="ignore"):
        scale = abs(float(np.linalg.det(whole[:3, :3]))) ** (1 / 3)
    try:
        if not math.isfinite(scale) or scale <= 0:
            raise ValueError("no scale")
        rotation, translation = torch.from_numpy(whole[:3, :3] / scale), torch.from_numpy(whole[:3, 3].copy())
        moved = Similarity(scale, rotation, translation).apply_gaussians(model)
    except ValueError as error:
        raise InputError(
            "a glTF node does more to Gaussians than move, turn and scale them evenly"
        ) from error
    parts = (moved.means, moved.quats, moved.log_scales, moved.sh)
    if not all(bool(each.isfinite().all()) for each in parts):
        raise InputError("NaN or infinite values in Gaussians of a glTF node")
    return moved


def _coefficients(degree: int) -> list[str]:
    """Names of the attributes of harmonics, in order."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(_COUNTS[d])]
