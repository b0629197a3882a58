"""The table of formats of 3DGS models. Does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

DECODED_SUFFIX = ".3dgs.safetensors"  # models with a decoder network


@dataclass(frozen=True)
class ModelFormat:
    """One file format of 3DGS models."""

    name: str
    kind: str  # the name of a file, with an article
    suffixes: tuple[str, ...]  # lower case, with the dot; the first is preferred
    codec: str  # "glb", "spz:SpzCodes": module or class of `formats/` with `read(data)` and `write(model)`
    magic: tuple[bytes, ...] = ()  # possible first bytes; empty, as `archive`: identified by suffix
    archive: tuple[bytes, ...] = ()  # possible first bytes, of an archive that may hold other data
    in_page: bool = False  # the page reads it (web/src/files/models.ts); others are converted for it
    is_exact: bool = False  # keeps every bit

    def starts(self, data: bytes) -> bool:
        """True if a file of this format may begin with these bytes."""
        return data.startswith((*self.magic, *self.archive))


_PLY = "compressed_ply:CompressedPlyCodes"  # `files/models.py` reads and writes plain ones by `ply`
# A file name belongs to the first format with a matching suffix.
FORMATS = (
    ModelFormat(
        "compressed PLY", "a compressed .ply", (".compressed.ply",), _PLY, magic=(b"ply",), in_page=True
    ),
    ModelFormat("PLY", "a .ply", (".ply",), _PLY, magic=(b"ply",), in_page=True, is_exact=True),
    ModelFormat(
        "SPZ", "an SPZ model", (".spz",), "spz:SpzCodes", (b"NGSP",), archive=(b"\x1f\x8b",), in_page=True
    ),
    ModelFormat("SOG", "an SOG model", (".sog",), "sog:SogCodes", archive=(b"PK\x03\x04",), in_page=True),
    ModelFormat("glTF", "a glTF file", (".glb",), "glb", magic=(b"glTF",)),
    ModelFormat(".splat", "a .splat model", (".splat",), "splat", in_page=True),
)
# Not a format of 3DGS models, so messages do not list it.
DECODED = ModelFormat("decoded", "a decoded model", (DECODED_SUFFIX,), "decoded_models", is_exact=True)
PLY = FORMATS[1]


def format_of(path: Path | str) -> ModelFormat | None:
    """The format of the suffix, or None."""
    name = Path(path).name.lower()
    return next((entry for entry in (*FORMATS, DECODED) if name.endswith(entry.suffixes)), None)


def known_suffixes() -> str:
    """The suffixes of all formats, for messages."""
    return ", ".join(suffix for entry in FORMATS for suffix in entry.suffixes)
