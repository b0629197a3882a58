"""`hide` of files: in a model's low bits, in codes, in colours or in appended Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from keyss.api.asking import HideResult, Secret, check_keys
from keyss.channels import AnyChannel, Publish, channel_for, open_content
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.models import read_model
from keyss.files.reading import read_file
from keyss.keys.encryption import MAX_PAYLOAD_BYTES
from keyss.methods.opened import HiddenFile
from keyss.rendering.difference import psnr_between
from keyss.runs.files import STEGOS, stego_name
from keyss.runs.folder import RunFolder
from keyss.runs.sources import PathLike, as_3dgs_model


def hide_files(
    cover: PathLike | Gaussians,
    secrets: Sequence[Secret],
    *,
    publish: Publish,
    channel: AnyChannel,
    out: PathLike | None,
    overwrite: bool,
) -> HideResult:
    """See `keyss.hide`. Opens the files again from what was written, as a reader does."""
    check_keys([each.key for each in secrets])
    folder = None
    if out is not None:
        read = [cover, *(each.file for each in secrets)]
        inputs = [Path(each) for each in read if isinstance(each, str | Path)]
        folder = RunFolder(out, "hide files", writes=STEGOS, inputs=inputs, overwrite=overwrite)
    hidden, model = [_read(each) for each in secrets], as_3dgs_model(cover, "the cover")
    keys = [each.key for each in secrets]
    payloads = [(key, each.payload()) for key, each in zip(keys, hidden, strict=True)]
    stego = channel_for(publish, channel).prepare(model).embed(payloads)
    with folder.work() if folder else nullcontext():
        name = stego_name(stego)
        there = folder.write({name: stego}) if folder else None
        as_read = read_model(there / name) if there else stego
        if [HiddenFile.of(open_content(as_read, key)) for key in keys] != hidden:
            raise RuntimeError("the hidden files do not open again from the published file")
    return HideResult(stego, psnr=psnr_between(model, stego))


def _read(secret: Secret) -> HiddenFile:
    """Raises InputError for a file that is missing or too large to be hidden, UsageError for no file."""
    if secret.file is None or secret.scene is not None or secret.model is not None:
        raise UsageError("expected secrets that are all files, or all scenes: hide the others by themselves")
    if isinstance(secret.file, bytes):
        return HiddenFile(secret.name, secret.file)
    path = Path(secret.file)
    return HiddenFile(secret.name or path.name, read_file(path, MAX_PAYLOAD_BYTES))
