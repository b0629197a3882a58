"""Reading and writing 3DGS models in all formats. CONTRIBUTING.md says how to add one."""

from __future__ import annotations

import io
import os
import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from keyss.core.errors import InputError, OutputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians
from keyss.files.atomic import atomic_write, check_not_an_input, check_output_file
from keyss.files.file_kinds import (
    START_BYTES,
    identify_content,
    identify_folder,
    is_foreign_archive,
    is_training,
    is_unpacked_sog,
    model_file,
)
from keyss.files.formats import ply
from keyss.files.formats.sog import pack_unpacked
from keyss.files.inputs import (
    MAX_BYTES,
    check_standard_output,
    is_standard,
    open_input,
    read_standard_input,
    write_standard_output,
)
from keyss.files.model_formats import (
    DECODED,
    DECODED_SUFFIX,
    FORMATS,
    PLY,
    ModelFormat,
    format_of,
    known_suffixes,
)
from keyss.files.ply_table import is_plain


def is_model_path(path: Path | str) -> bool:
    """True if a path has the suffix of a model format."""
    return format_of(path) is not None


def is_model_source(path: Path | str) -> bool:
    """True if `read_model` accepts a path: a model suffix, an unpacked SOG, or a training's output folder."""
    return is_model_path(path) or is_unpacked_sog(Path(path)) or is_training(path)


def read_model(path: Path | str) -> Gaussians:
    """The model at `path`, on the CPU; "-" is standard input. The first bytes identify the format.

    Of an unpacked SOG, `path` is the folder or its meta.json. In the output folder of another program's
    training, it is the latest model, with a KeyssWarning. Raises
    InputError for a file that is missing, of unknown format, named like another format, or not a complete
    and finite model.
    """
    if is_standard(path):
        return model_of_bytes("standard input", read_standard_input())
    path = model_file(path)
    if os.path.isdir(path):
        kind = identify_folder(path) or "a folder"
        raise InputError(f"{path}: expected the file of a 3DGS model ({known_suffixes()}), found {kind}")
    if not os.path.isfile(path):
        problem = "found neither a file nor a folder" if os.path.exists(path) else "but there is no such file"
        raise InputError(f"{path}: expected a 3DGS model ({known_suffixes()}), {problem}")
    if is_unpacked_sog(path):
        return model_of_bytes(path.with_suffix(".sog"), pack_unpacked(path))
    with open_input(path) as file:
        return _read(file, path.name)


def reads_as(path: Path | str, model: Gaussians, data: bytes | None = None) -> bool:
    """True if `read_model` gives `model`, to the bit, for a .ply; takes no memory for a second model.

    `data`: the content of the file, if it is not written yet. Raises InputError as `read_model` does.
    """
    if type(model) is not Gaussians or _for_writing(path) is not PLY:
        return False
    with open_input(Path(path)) if data is None else io.BytesIO(data) as file:
        return ply.holds(file, model)


def model_of_bytes(path: Path | str, data: bytes) -> Gaussians:
    """`read_model` for a file at `path` that contains `data`."""
    try:
        return _read(io.BytesIO(data), Path(path).name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_model(path: Path | str, model: Gaussians) -> None:
    """Atomically write `model` in the format of the suffix; "-" is standard output, in PLY.

    PLY keeps every number; the others round, and most of them sort: see docs/formats.md. Raises UsageError
    for an unknown suffix, OutputError for a model that is empty, not finite or out of the format's range, and
    on system errors.
    """
    if is_standard(path):
        write_standard_output(model_bytes(path, model))
        return
    _for_writing(path)  # refuses unknown suffixes before a file is opened
    with atomic_write(path) as file:
        _write(file, path, model)


def model_bytes(path: Path | str, model: Gaussians) -> bytes:
    """The bytes that `write_model` would write to `path`. Raises as it does."""
    file = io.BytesIO()
    _write(file, path, model)
    return file.getvalue()


def keeps_low_bits(path: Path | str) -> bool:
    """True if the format of the suffix keeps every bit. Raises UsageError for unknown suffixes."""
    return _for_writing(path).is_exact


def check_model_output(path: Path | str, overwrite: bool, inputs: Sequence[Path] = ()) -> Path:
    """`path`, if `write_model` may write there without overwriting one of the `inputs`.

    Raises UsageError for an unknown suffix, and what `check_output_file` and `check_not_an_input` raise.
    """
    _for_writing(path)
    if is_standard(path):
        check_standard_output()
        return Path(path)
    check_not_an_input(path, inputs)
    return check_output_file(path, overwrite)


def _for_writing(path: Path | str) -> ModelFormat:
    """The format of the suffix. Raises UsageError if it is unknown."""
    model_format = PLY if is_standard(path) else format_of(path)
    if model_format is None:
        raise UsageError(f"cannot write a model as {path}: expected a name that ends in {known_suffixes()}")
    return model_format


def _write(file: BinaryIO, path: Path | str, model: Gaussians) -> None:
    model_format = _for_writing(path)
    if isinstance(model, DecodedGaussians) != (model_format is DECODED):
        raise UsageError(
            f"cannot write {path}: {DECODED_SUFFIX}, which `keyss render` reads, is for models which a "
            "network decodes; all others have other names, such as .ply"
        )
    try:
        if model_format is PLY:
            ply.write(model, file)
        else:
            file.write(_codec(model_format).write(model))
    except OutputError as error:
        raise OutputError(f"cannot write {path}: {error}") from error


def _read(file: BinaryIO, name: str) -> Gaussians:
    """The model in an open file, in the format of its first bytes, which must not contradict `name`."""
    start = file.read(START_BYTES)
    file.seek(0)
    fitting = [] if is_foreign_archive(start) else [entry for entry in FORMATS if entry.starts(start)]
    named = format_of(name)
    if named in fitting or (named and start and not fitting and not (named.magic or named.archive)):
        return _read_as(named, file)
    if not fitting:
        kind = identify_content("" if named else name, start)  # the content refutes the name of a model
        raise InputError(f"expected a 3DGS model ({known_suffixes()}), found {kind}")
    if named is not None:
        raise InputError(
            f"the name says {named.name}, but the content is {fitting[-1].name}; "
            f"rename it to end in {fitting[-1].suffixes[0]}"
        )
    return _read_as(fitting[-1], file)


def _read_as(model_format: ModelFormat, file: BinaryIO) -> Gaussians:
    """The model in an open file, on the CPU. Raises InputError."""
    if model_format.magic == (b"ply",) and is_plain(file):
        return ply.read(file)
    data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(f"expected at most {MAX_BYTES:,} bytes, found more")
    with np.errstate(all="ignore"):  # values that are not finite are reported at the end
        model: Gaussians = _codec(model_format).read(data)
    return model


def _codec(model_format: ModelFormat) -> Any:
    return pkgutil.resolve_name(f"keyss.files.formats.{model_format.codec}")
