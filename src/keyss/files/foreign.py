"""Names files that keyss does not read as models, and says what to do with them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from keyss.files.reading import open_input

CONVERT = "convert it to .ply first, e.g. with `splat-transform IN OUT.ply`"
_MODEL = "give it where a model is asked for"
_EXPORT = "export a .ply from the program that made it"
_UNPACK = "unpack it, and give the folder or the model that is in it"
_POSES = "a scene is a folder of photos with their poses, e.g. from COLMAP"


@dataclass(frozen=True)
class _Kind:
    name: str  # with its article
    advice: str
    suffixes: tuple[str, ...] = ()
    magic: tuple[bytes, ...] = ()  # possible first bytes


# The first kind whose suffix fits, else the first whose magic does, since some formats are ZIP archives.
_KINDS = (
    _Kind("an SPZ model", _MODEL, (".spz",), (b"NGSP",)),
    _Kind("an SOG model", _MODEL, (".sog",)),
    _Kind("a .splat model", _MODEL, (".splat",)),
    _Kind("a glTF file", _MODEL, (".glb",), (b"glTF",)),
    _Kind("a .ksplat model", CONVERT, (".ksplat",)),
    _Kind("an LCC model", CONVERT, (".lcc", ".lcc2")),
    _Kind("an unpacked SOG model", CONVERT, ("meta.json",)),
    _Kind("a glTF file with its data beside it", "export a .glb from the program that made it", (".gltf",)),
    _Kind("a table", _EXPORT, (".csv", ".tsv")),
    _Kind("a web page", _EXPORT, (".html", ".htm"), (b"<!DOCTYPE", b"<html")),
    _Kind("a JSON file", "give the folder that it lies in", (".json",)),
    _Kind("a PLY file under another name", "rename it to end in .ply", magic=(b"ply\n", b"ply\r")),
    _Kind("gzip data", _UNPACK, (".gz",), (b"\x1f\x8b",)),
    _Kind("a ZIP archive", _UNPACK, (".zip",), (b"PK\x03\x04",)),
    _Kind("an archive", _UNPACK, (".tar", ".tgz", ".7z", ".rar"), (b"7z\xbc\xaf\x27\x1c", b"Rar!")),
    _Kind(
        "a picture",
        _POSES,
        (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic"),
        (b"\x89PNG", b"\xff\xd8\xff"),
    ),
    _Kind("a video", _POSES, (".mp4", ".mov", ".mkv", ".avi", ".webm")),
)


def what_it_is(path: Path) -> str:
    """The kind of a file that keyss does not read, and what to do with it; to follow "expected ..., found".

    Raises InputError if it cannot be read.
    """
    if not path.is_file():  # reading a pipe could block for ever
        return "neither a file nor a folder"
    with open_input(path) as file:
        return kind_of(path.name, file.read(16))


def kind_of(name: str, start: bytes) -> str:
    """`what_it_is` for a file with this name and these first 16 bytes."""
    if not start:
        return "an empty file"
    by_suffix = (kind for kind in _KINDS if name.lower().endswith(kind.suffixes))
    by_magic = (kind for kind in _KINDS if start.startswith(kind.magic))
    kind = next(by_suffix, None) or next(by_magic, None)
    if kind is None:
        return "a file of no kind that keyss knows"  # does not quote it: it may be a key
    if kind.advice == CONVERT:
        return f"{kind.name}, which keyss does not read; {CONVERT}"
    return f"{kind.name}; {kind.advice}"
