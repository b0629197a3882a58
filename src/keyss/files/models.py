"""3DGS models on disk, whatever their format: the one door through which the rest of the program goes.

A new format is a module with a reader and a writer, and one entry in `FORMATS`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError, OutputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import atomic_write
from keyss.files.foreign import what_it_is
from keyss.files.output import check_not_an_input, check_output_file
from keyss.files.ply import read_ply, write_ply
from keyss.files.ply_rows import is_compressed
from keyss.files.streams import MemoryInput, MemoryOutput, StandardInput, StandardOutput, is_standard

DECODED_SUFFIX = ".3dgs.safetensors"  # of models whose pictures a network makes


@dataclass(frozen=True)
class ModelFormat:
    """One file format of 3DGS models."""

    name: str
    suffixes: tuple[str, ...]  # in lower case and with the dot; the first is the usual one
    magic: tuple[bytes, ...]  # of which one begins every file; none: only the name tells
    read: Callable[[Path | StandardInput], Gaussians]  # on the CPU; raises InputError
    write: Callable[[Path | StandardOutput, Gaussians], None] | None  # atomically; raises OutputError
    exact: bool = False  # whether all numbers come back to the last bit


def _format(module: str) -> Any:
    """A module of `keyss.files.formats`, imported when it is needed: some take their time."""
    return importlib.import_module(f"keyss.files.formats.{module}")


def _reader(module: str) -> Callable[[Path | StandardInput], Gaussians]:
    """What reads files by `read_MODULE`, which takes bytes."""

    def read(source: Path | StandardInput) -> Gaussians:
        try:
            data = _format("common").read_whole(source)
            with np.errstate(all="ignore"):  # what is not finite is reported in the end
                model: Gaussians = getattr(_format(module), f"read_{module}")(data)
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        except OSError as error:
            raise InputError(f"cannot read {source}: {error.strerror or error}") from error
        return model

    return read


def _writer(module: str) -> Callable[[Path | StandardOutput, Gaussians], None]:
    """What writes files by `write_MODULE`, which gives bytes."""

    def write(target: Path | StandardOutput, model: Gaussians) -> None:
        try:
            data = getattr(_format(module), f"write_{module}")(_format("common").writable(model))
        except OutputError as error:
            raise OutputError(f"cannot write {target}: {error}") from error
        with atomic_write(target) as file:
            file.write(data)

    return write


def _write_decoded(target: Path | StandardOutput, model: Gaussians) -> None:
    """Only what a network decodes: others have formats of their own."""
    if not isinstance(model, DecodedGaussians):
        raise UsageError(
            f"cannot write a 3DGS model as {target}: files that end in {DECODED_SUFFIX} are for models that "
            "a network decodes; take a name that ends in .ply"
        )
    try:
        data = _format("decoded").write_decoded(model)
    except OutputError as error:
        raise OutputError(f"cannot write {target}: {error}") from error
    with atomic_write(target) as file:
        file.write(data)


def _read_any_ply(source: Path | StandardInput) -> Gaussians:
    """Compressed files end in .ply, too."""
    return _reader("compressed_ply")(source) if is_compressed(source) else read_ply(source)


def _read_sog_folder(source: Path | StandardInput) -> Gaussians:
    model: Gaussians = _format("sog").read_sog_folder(source)
    return model


# The first whose suffix fits a name is its format.
FORMATS = [
    ModelFormat("compressed PLY", (".compressed.ply",), (b"ply",), _read_any_ply, _writer("compressed_ply")),
    ModelFormat("PLY", (".ply",), (b"ply",), _read_any_ply, write_ply, exact=True),
    ModelFormat("SPZ", (".spz",), (b"NGSP", b"\x1f\x8b"), _reader("spz"), _writer("spz")),
    ModelFormat("SOG", (".sog",), (b"PK\x03\x04",), _reader("sog"), _writer("sog")),
    ModelFormat("SOG", ("meta.json",), (), _read_sog_folder, None),
    ModelFormat("glTF", (".glb",), (b"glTF",), _reader("glb"), _writer("glb")),
    ModelFormat(".splat", (".splat",), (), _reader("splat"), _writer("splat")),
    ModelFormat(".ksplat", (".ksplat",), (), _reader("ksplat"), None),
]
# No format of 3DGS models: it is read where it is named.
_DECODED = ModelFormat("decoded", (DECODED_SUFFIX,), (), _reader("decoded"), _write_decoded, exact=True)
_PLY = FORMATS[1]


def is_model_path(path: Path | str) -> bool:
    """Whether a name ends as those of model files do; the file itself is not looked at."""
    return _by_suffix(path) is not None


def read_model(path: Path | str) -> Gaussians:
    """The model at `path`, on the CPU. The format is told by the first bytes; "-" is standard input.

    Raises InputError for a file that is missing, of no known format, named as one of another format, or not
    a whole and finite model.
    """
    return read_source(StandardInput() if is_standard(path) else Path(path))


def read_source(source: Path | StandardInput) -> Gaussians:
    """`read_model` for what is open already."""
    return _by_content(source).read(source)


def write_model(path: Path | str, model: Gaussians) -> None:
    """Atomically write `model` in the format that the suffix of `path` names; as PLY to "-", standard output.

    PLY keeps every number, the others round, and most of them sort; docs/formats.md has by how much. Raises
    UsageError for an unknown suffix, OutputError for a model that is empty, not finite or beyond what the
    format holds, and when the system refuses.
    """
    _, write = _for_writing(path, model)
    write(StandardOutput() if is_standard(path) else Path(path), model)


def model_bytes(path: Path | str, model: Gaussians) -> bytes:
    """What `write_model` would write to `path`. Raises as it does."""
    memory = MemoryOutput(str(path))
    _for_writing(path, model)[1](memory, model)
    return memory.data


def model_of_bytes(path: Path | str, data: bytes) -> Gaussians:
    """What `read_model` would read from `path`, were `data` there; `write_model` has to know its suffix."""
    return _for_writing(path)[0].read(MemoryInput(str(path), data))


def keeps_low_bits(path: Path | str) -> bool:
    """Whether `write_model` keeps all numbers to the last bit in the format that `path` names.

    Raises UsageError for an unknown suffix.
    """
    return _for_writing(path)[0].exact


def check_model_output(path: Path | str, overwrite: bool, inputs: Sequence[Path] = ()) -> Path:
    """`path`, if `write_model` may write there: UsageError for its suffix, and see `check_output_file`.

    None of the `inputs` may be overwritten, whatever name leads to it.
    """
    _for_writing(path)
    if is_standard(path):
        StandardOutput().check()
        return Path(path)
    check_not_an_input(path, inputs)
    return check_output_file(path, overwrite)


def _by_suffix(path: Path | str) -> ModelFormat | None:
    name = Path(path).name.lower()
    return next((each for each in (*FORMATS, _DECODED) if name.endswith(each.suffixes)), None)


def _for_writing(
    path: Path | str, model: Gaussians | None = None
) -> tuple[ModelFormat, Callable[[Path | StandardOutput, Gaussians], None]]:
    """The format that a name means, and what writes it. Raises UsageError, also where it cannot hold it."""
    found = _PLY if is_standard(path) else _by_suffix(path)
    if found is None or found.write is None:
        known = ", ".join(suffix for each in FORMATS if each.write for suffix in each.suffixes)
        raise UsageError(f"cannot write a model as {path}: expected a name that ends in {known}")
    if isinstance(model, DecodedGaussians) and found.write is not _write_decoded:
        raise UsageError(
            f"cannot write {path}: a network makes the pictures of this model, which 3DGS files do not hold; "
            f"take a name that ends in {DECODED_SUFFIX}, and `keyss render` draws it"
        )
    return found, found.write


def _by_content(path: Path | StandardInput) -> ModelFormat:
    try:
        if path.is_dir():
            raise InputError(
                f"{path}: expected the file of a 3DGS model ({known_suffixes()}), found a folder"
            )
        if not path.is_file():
            raise InputError(f"{path}: expected a 3DGS model ({known_suffixes()}), but there is no such file")
        with path.open("rb") as file:
            start = file.read(max(len(magic) for each in FORMATS for magic in each.magic))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    fitting = [each for each in FORMATS if each.magic and start.startswith(each.magic)]
    named = _by_suffix(str(path))
    if named in fitting or (named and start and not named.magic and not fitting):
        return named
    if not fitting:
        raise InputError(f"{path}: expected a 3DGS model ({known_suffixes()}), found {what_it_is(path)}")
    found = fitting[-1]
    if named is not None:
        raise InputError(
            f"{path}: the name says {named.name}, but the content is {found.name}; "
            f"rename it to end in {found.suffixes[0]}"
        )
    return found


def known_suffixes() -> str:
    """Ends of names of the formats that are read, as they stand in messages."""
    return ", ".join(suffix for each in FORMATS for suffix in each.suffixes)
