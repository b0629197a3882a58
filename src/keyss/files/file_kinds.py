"""Identifies files and folders, with advice for kinds that keyss does not read.

Finds the model in the output folder of another program's training.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import BackendError, InputError, KeyssWarning
from keyss.files.inputs import open_input
from keyss.files.model_formats import FORMATS

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
START_BYTES = 256  # enough to identify a file
_META, _MAX_META_BYTES = "meta.json", 1 << 20  # metadata of an unpacked SOG
_ZIP, _GZIP = b"PK\x03\x04", b"\x1f\x8b"
_POSES = "a scene is a folder of photos with their poses, e.g. from COLMAP"

# Models written by the trainers of Inria and gsplat, and by Nerfstudio's export; `*` is the number of steps.
_MODELS = (
    "point_cloud/iteration_*/point_cloud.ply",
    "iteration_*/point_cloud.ply",
    "point_cloud.ply",
    "ply/point_cloud_*.ply",
    "point_cloud_*.ply",
    "splat.ply",
    "exports/splat/splat.ply",
)
_CHECKPOINTS = ("ckpts/*.pt", "nerfstudio_models/*.ckpt", "chkpnt*.pth", "*.ckpt")
# Not the output of a training: scenes, which may have a model beside their photos, and keyss runs.
_OTHERS = (
    *("transforms.json", "transforms_train.json", "sparse", "cameras.bin", "cameras.txt", "colmap"),
    *("publish", "private"),
)


@dataclass(frozen=True)
class _Kind:
    name: str  # with an article
    advice: str
    suffixes: tuple[str, ...] = ()
    magic: tuple[bytes, ...] = ()  # possible first bytes
    member: tuple[bytes, ...] = ()  # possible suffixes of the first file in a ZIP archive


# The first matching suffix wins, else the first matching content.
_KINDS = (
    *(
        _Kind(entry.kind, _MODEL, entry.suffixes, entry.magic)
        for entry in FORMATS
        if entry.magic != (b"ply",)
    ),
    _Kind("a .ksplat model", CONVERT, (".ksplat",)),
    _Kind("an LCC model", CONVERT, (".lcc", ".lcc2")),
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


def is_unpacked_sog(path: Path) -> bool:
    """True for the meta.json of a SOG whose images lie beside it, and for its folder."""
    meta = path if path.name == _META else path / _META
    try:
        with open_input(meta) as file:
            return b'"means"' in file.read(_MAX_META_BYTES)
    except InputError:
        return False


def is_training(folder: Path | str) -> bool:
    """True for a training's output folder that contains a model."""
    return _latest_model(Path(folder)) is not None


def model_file(path: Path | str) -> Path:
    """The file to read at a path.

    The latest model in a training's output folder, with a KeyssWarning; the meta.json of an unpacked SOG; any
    other path unchanged.
    """
    path = Path(path)
    if path.is_dir() and is_unpacked_sog(path):
        return path / _META
    if model := _latest_model(path):
        warnings.warn(
            f"{path}: output of a training; its model is {model.relative_to(path)}",
            KeyssWarning,
            stacklevel=2,
        )
    return model or path


def identify_folder(folder: Path) -> str | None:
    """`identify_file` for a folder that is neither a scene nor a model; None if unknown."""
    if any(True for pattern in _CHECKPOINTS for _ in folder.glob(pattern)):
        return f"a folder of checkpoints of a training; {_CHECKPOINT}"
    return None


def _latest_model(folder: Path) -> Path | None:
    if not os.path.isdir(folder) or any(os.path.lexists(folder / other) for other in _OTHERS):
        return None
    for pattern in _MODELS:
        models = {str(path.relative_to(folder)): path for path in folder.glob(pattern) if path.is_file()}
        if models:
            return models[max(models, key=lambda name: [int(step) for step in re.findall(r"[0-9]+", name)])]
    return None


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
