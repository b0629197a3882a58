"""3DGS models on disk, whatever their format: the one door through which the rest of the program goes.

A new format is a module with a reader and a writer, and one entry in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.foreign import what_it_is
from keyss.files.output import check_not_an_input, check_output_file
from keyss.files.ply import read_ply, write_ply
from keyss.files.streams import StandardInput, StandardOutput, is_standard


@dataclass(frozen=True)
class ModelFormat:
    """One file format of 3DGS models."""

    name: str
    suffixes: tuple[str, ...]  # in lower case and with the dot; the first is the usual one
    magic: bytes  # the first bytes of every file
    read: Callable[[Path | StandardInput], Gaussians]  # on the CPU; raises InputError
    write: Callable[[Path | StandardOutput, Gaussians], None]  # atomically; raises OutputError


_COMPRESSED = ".compressed.ply"  # another format, which programs know by this name

FORMATS = [ModelFormat("PLY", (".ply",), b"ply", read_ply, write_ply)]


def is_model_path(path: Path | str) -> bool:
    """Whether a name ends as those of model files do; the file itself is not looked at."""
    return _by_suffix(path) is not None


def read_model(path: Path | str) -> Gaussians:
    """The model at `path`, on the CPU. The format is told by the first bytes; "-" is standard input.

    Raises InputError for a file that is missing, of no known format, named as one of another format, or not
    a whole and finite model.
    """
    source = StandardInput() if is_standard(path) else Path(path)
    return _by_content(source).read(source)


def write_model(path: Path | str, model: Gaussians) -> None:
    """Atomically write `model` in the format that the suffix of `path` names; as PLY to "-", standard output.

    Raises UsageError for an unknown suffix, OutputError for a model that is empty or not finite and when the
    system refuses.
    """
    _for_writing(path).write(StandardOutput() if is_standard(path) else Path(path), model)


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
    return next((each for each in FORMATS if name.endswith(each.suffixes)), None)


def _for_writing(path: Path | str) -> ModelFormat:
    found = FORMATS[0] if is_standard(path) else _by_suffix(path)
    if found is None or Path(path).name.lower().endswith(_COMPRESSED):
        raise UsageError(f"cannot write a model as {path}: expected a name that ends in {_known()}")
    return found


def _by_content(path: Path | StandardInput) -> ModelFormat:
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected the file of a 3DGS model ({_known()}), found a folder")
        if not path.is_file():
            raise InputError(f"{path}: expected a 3DGS model ({_known()}), but there is no such file")
        with path.open("rb") as file:
            start = file.read(max(len(each.magic) for each in FORMATS))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    found = next((each for each in FORMATS if start.startswith(each.magic)), None)
    if found is None:
        raise InputError(f"{path}: expected a 3DGS model ({_known()}), found {what_it_is(path)}")
    named = _by_suffix(str(path)) or found
    if named is not found:
        raise InputError(
            f"{path}: the name says {named.name}, but the content is {found.name}; "
            f"rename it to end in {found.suffixes[0]}"
        )
    return found


def _known() -> str:
    return ", ".join(suffix for each in FORMATS for suffix in each.suffixes)
