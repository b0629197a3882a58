"""`hide_files` and `reveal_file`: any files in a model's low bits, or in colours that survive rounding."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from keyss._verbs.asking import check_keys
from keyss.channels import robust
from keyss.channels.low_bits import LOW_BITS
from keyss.channels.opening import open_content
from keyss.channels.rooms import AnyChannel, Publish, room_in
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import write_bytes
from keyss.files.models import read_model
from keyss.files.output import check_not_an_input, check_output_file
from keyss.files.reading import read_file
from keyss.keys.encryption import MAX_PAYLOAD_BYTES
from keyss.methods.hidden_file import HiddenFile
from keyss.rendering.difference import cost
from keyss.runs.config import PathLike
from keyss.runs.files import STEGOS, stego_name, writers
from keyss.runs.folder import RunFolder, check_not_published
from keyss.runs.opening import as_3dgs_model, as_model, naming_what_opens_nothing


@dataclass(frozen=True)
class SecretFile:
    """A file, or its bytes, and the key that is to open it."""

    file: PathLike | bytes
    key: str = field(repr=False)
    name: str = ""  # to be shown with it, by default the file's

    def read(self) -> HiddenFile:
        """Raises InputError for a file that is missing or larger than any that could be hidden."""
        if isinstance(self.file, bytes):
            return HiddenFile(self.name, self.file)
        path = Path(self.file)
        return HiddenFile(self.name or path.name, read_file(path, MAX_PAYLOAD_BYTES))


@dataclass(frozen=True)
class HideFilesResult:
    """A model with files in it, and what that changed."""

    stego: Gaussians  # to be published
    psnr: float  # dB, of views around it against those of the cover; at most 120
    sizes: tuple[int, ...]  # bytes of the files


def hide_files(
    cover: PathLike | Gaussians,
    files: Sequence[SecretFile],
    *,
    publish: Publish = "ply",
    channel: AnyChannel = "colours",
    strength: float = robust.STRENGTH,
    repair: bool = False,
    out: PathLike | None = None,
    overwrite: bool = False,
) -> HideFilesResult:
    """Hide files in a model, each under its own key, and open them again as a reader will.

    `publish`: "ply" writes into low bits, and "spz", "sog" and "compressed-ply" into the codes of such a
    file, which have to be passed on as they are; "any" writes what survives other formats, by `channel`: into
    colours, at a cost of `strength` (dB PSNR that views of the model keep at least), less with `repair` (a
    short fit of the harmonics afterwards), or into appended Gaussians, which have room for far more and which
    everybody can see are there. `out` (a folder) gets `publish/stego.ply`, or `.spz` and so on. Raises
    InputError for a cover whose low bits are not random, or that has too few Gaussians, UsageError for files
    that do not fit, which names what would, for equal keys, and for a `repair` that cannot be.
    """
    if not files:
        raise UsageError("expected at least one file to hide")
    if repair and (publish != "any" or channel != "colours"):
        raise UsageError('`repair` is for what is written into colours (`publish="any", channel="colours"`)')
    check_keys([each.key for each in files])
    folder = None
    if out is not None:
        read = [cover, *(each.file for each in files)]
        inputs = [Path(each) for each in read if isinstance(each, str | Path)]
        folder = RunFolder(out, "hide files", writes=STEGOS, inputs=inputs, overwrite=overwrite)
    hidden, model = [each.read() for each in files], as_3dgs_model(cover, "the cover")
    keys = [each.key for each in files]
    payloads = [(key, each.payload()) for key, each in zip(keys, hidden, strict=True)]
    if publish == "ply":
        stego = LOW_BITS.prepare(model).embed(payloads)
    else:
        stego = room_in(model, publish, channel, strength=strength, repair=repair).embed(payloads)
    with folder.work() if folder else nullcontext():
        name = stego_name(stego)
        there = folder.write(writers({name: stego})) if folder else None
        as_read = read_model(there / name) if there else stego
        if [open_file_in(as_read, key) for key in keys] != hidden:
            raise RuntimeError("what was written does not open again as it should")
    return HideFilesResult(stego, cost(model, stego), tuple(len(each.data) for each in hidden))


def reveal_file(
    stego: PathLike | Gaussians, key: str, *, out: PathLike | None = None, overwrite: bool = False
) -> HiddenFile:
    """The file that `key` opens in a model; `out` (a file) gets its bytes.

    Raises WrongKeyError for a key that opens nothing, InputError for one that opens a scene and for damage.
    """
    path = None
    if out is not None:
        check_not_an_input(out, [Path(stego)] if isinstance(stego, str | Path) else [])
        path = check_output_file(out, overwrite)
        check_not_published(path)
    with naming_what_opens_nothing():
        found = open_file_in(as_model(stego), key)
    if path is not None:
        write_bytes(path, found.data)
    return found


def open_file_in(stego: Gaussians, key: str) -> HiddenFile:
    """The file that `key` opens. Raises WrongKeyError and InputError."""
    return HiddenFile.of(open_content(stego, key))
