"""Identifies files by name and content, with advice for kinds that keyss does not read."""

from __future__ import annotations

import os
import shutil
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import BackendError
from keyss.files.inputs import open_input

CONVERT = "convert it to .ply first, e.g. with `splat-transform IN OUT.ply`"
_MODEL = "give it where a model is asked for"
_EXPORT = "export a .ply from the program that made it"
FIT = "keyss hides 3DGS models, which a training such as `keyss fit` makes from photos"
_CHECKPOINT = (
    "keyss never opens pickles, which can run programs; export a .ply: gsplat's with "
    "`simple_trainer.py --save_ply`, Nerfstudio with `ns-export gaussian-splat`, Inria's train.py writes "
    "point_cloud/iteration_N/point_cloud.ply by itself"
)
_UNPACK = "unpack it, and give the folder or the model inside"
CHECKPOINTS = f"checkpoints of a training; {_CHECKPOINT}"
START_BYTES = 256  # enough to identify a file
_ZIP, _GZIP = b"PK\x03\x04", b"\x1f\x8b"
_POSES = "a scene is a folder of photos with their poses, e.g. from COLMAP"


@dataclass(frozen=True)
class _Kind:
    name: str  # with an article
    advice: str
    suffixes: tuple[str, ...] = ()
    magic: tuple[bytes, ...] = ()  # possible first bytes
    member: tuple[bytes, ...] = ()  # possible suffixes of the first file in a ZIP archive


# The first matching suffix wins, else the first matching content.
_KINDS = (
    _Kind("an SPZ model", _MODEL, (".spz",), (b"NGSP",)),
    _Kind("an SOG model", _MODEL, (".sog",)),
    _Kind("a .splat model", _MODEL, (".splat",)),
    _Kind("a glTF file", _MODEL, (".glb",), (b"glTF",)),
    _Kind("a .ksplat model", CONVERT, (".ksplat",)),
    _Kind("an LCC model", CONVERT, (".lcc", ".lcc2")),
    _Kind("an unpacked SOG model", CONVERT, ("meta.json",)),
    _Kind("a glTF file with its data beside it", "export a .glb from the program that made it", (".gltf",)),
    _Kind(
        "a checkpoint of a training",
        _CHECKPOINT,
        (".pt", ".pth", ".ckpt", ".pkl"),
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        (b"data.pkl",),
    ),
    _Kind("arrays of NumPy", _EXPORT, (".npz", ".npy"), (b"\x93NUMPY",), (b".npy",)),
    _Kind("a USD scene", _EXPORT, (".usdz", ".usd", ".usda", ".usdc"), (b"PXR-USDC",), (b".usdc", b".usda")),
    _Kind("a mesh", FIT, (".obj", ".fbx", ".stl", ".dae")),
    _Kind("a point cloud", FIT, (".las", ".laz", ".e57", ".pcd", ".xyz"), (b"LASF", b"ASTM-E57")),
    _Kind("a project of a training program", _EXPORT, (".psht",)),
    _Kind("a table", _EXPORT, (".csv", ".tsv")),
    _Kind("a web page", _EXPORT, (".html", ".htm"), (b"<!DOCTYPE", b"<html")),
    _Kind("a JSON file", "give the folder that it lies in", (".json",)),
    _Kind("a PLY file under another name", "rename it to end in .ply", magic=(b"ply\n", b"ply\r")),
    _Kind("gzip data", _UNPACK, (".gz",), (_GZIP,)),
    _Kind("a ZIP archive", _UNPACK, (".zip",), (_ZIP,)),
    _Kind("an archive", _UNPACK, (".tar", ".tgz", ".7z", ".rar"), (b"7z\xbc\xaf\x27\x1c", b"Rar!")),
    _Kind(
        "a picture",
        _POSES,
        (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic"),
        (b"\x89PNG", b"\xff\xd8\xff"),
    ),
    _Kind("a video", _POSES, (".mp4", ".mov", ".mkv", ".avi", ".webm")),
)


def identify_file(path: Path) -> str:
    """The kind of a file, and advice, to follow "expected ..., found". Raises InputError if unreadable."""
    if not path.is_file():  # reading a pipe could block forever
        return "neither a file nor a folder"
    with open_input(path) as file:
        return identify_content(path.name, file.read(START_BYTES))


def identify_content(name: str, start: bytes) -> str:
    """`identify_file` from a name and the first START_BYTES."""
    if not start:
        return "an empty file"
    by_suffix = (kind for kind in _KINDS if name.lower().endswith(kind.suffixes))
    by_magic = (kind for kind in _KINDS if start.startswith(kind.magic))
    kind = next(by_suffix, None) or _kind_in_zip(start) or next(by_magic, None)
    if kind is None:
        return "a file of unknown kind"  # not quoted: it may be a key
    if kind.advice == CONVERT:
        return f"{kind.name}, which keyss does not read; {CONVERT}"
    return f"{kind.name}; {kind.advice}"


def is_foreign_archive(start: bytes) -> bool:
    """True for ZIP or gzip data other than a model, such as a checkpoint, from the first START_BYTES."""
    with suppress(zlib.error):
        if start.startswith(_GZIP):
            return zlib.decompressobj(31).decompress(start, 4) != b"NGSP"
    return _kind_in_zip(start) is not None


def _kind_in_zip(start: bytes) -> _Kind | None:
    """The kind of a ZIP archive, from the name of its first file."""
    if not start.startswith(_ZIP):
        return None
    member = start[30 : 30 + int.from_bytes(start[26:28], "little")]
    return next((kind for kind in _KINDS if kind.member and member.endswith(kind.member)), None)


def find_splat_transform() -> str:
    """The path in KEYSS_SPLAT_TRANSFORM, else in ./node_modules, else on the PATH. Raises BackendError."""
    here = Path("node_modules") / ".bin" / "splat-transform"
    named = os.environ.get("KEYSS_SPLAT_TRANSFORM")
    program = named or (str(here.absolute()) if here.exists() else shutil.which("splat-transform"))
    if not program or not Path(program).exists():
        raise BackendError(
            "splat-transform is not installed (npm install --no-save @playcanvas/splat-transform@2.7.1, "
            "or its path in KEYSS_SPLAT_TRANSFORM)"
        )
    return program
