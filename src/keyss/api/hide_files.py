"""`hide_files`: hide any files in a model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from keyss.api.hide_arguments import check_keys
from keyss.channels import Channel, ConvertedChannel, Format, Payload, Publish, channel_for, open_payload
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.formats.ply import with_extras
from keyss.files.inputs import as_text, read_file
from keyss.files.models import read_model
from keyss.keys.encryption import MAX_PAYLOAD_BYTES, compressed_size
from keyss.methods.hidden import HiddenFile
from keyss.rendering.orbit import is_model, psnr_between
from keyss.runs.files import STEGOS, PathLike, as_3dgs_model, stego_name
from keyss.runs.folder import RunFolder

_MOST = 10  # times the estimated capacity; no channel holds more


@dataclass(frozen=True)
class SecretFile:
    """A file to hide, and its key."""

    file: PathLike | bytes
    key: str = field(repr=False)
    name: str = ""  # displayed when the file is revealed; default: its own name


@dataclass(frozen=True)
class HideFilesResult:
    """The result of `hide_files`."""

    stego: Gaussians | None  # publish this; None after a dry run
    psnr: float  # dB of the stego model's views to the cover's, at most 120


def hide_files(
    cover: PathLike | Gaussians,
    secrets: Sequence[SecretFile],
    *,
    publish: Publish = "unchanged",
    format: Format | None = None,
    channel: ConvertedChannel = "colours",
    out: PathLike | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> HideFilesResult:
    """Hide files in a model, each under its own key, and open them again to check.

    `out` (a folder) gets `publish/` with the stego model. `publish`, `format`, `channel`: see `hide`;
    `dry_run`: write nothing, and return only the PSNR. Raises UsageError if the files do not fit (with
    "unchanged", into what goes unnoticed), and other KeyssErrors.
    """
    if isinstance(cover, Scene) or not is_model(cover):
        raise UsageError("hiding a file needs a model as the cover; `keyss fit` makes one from photos")
    keys = [each.key for each in secrets]
    check_keys(keys)
    folder = None
    if out is not None and not dry_run:
        read = [cover, *(each.file for each in secrets)]
        inputs = [Path(each) for each in read if isinstance(each, str | Path)]
        folder = RunFolder(out, "hide files", writes=STEGOS, inputs=inputs, overwrite=overwrite)
    hidden, model = [_read(each) for each in secrets], as_3dgs_model(cover, "the cover")
    chosen = channel_for(publish, channel, format, model)
    payloads = [(key, each.payload()) for key, each in zip(keys, hidden, strict=True)]
    _check_sizes(chosen, model, [payload for _, payload in payloads])
    try:
        stego = chosen.prepare(model).embed(payloads)
    except UsageError as error:
        if chosen.grows:
            raise
        raise UsageError(f'{error}; `publish="converted", channel="appended"` has room for all') from error
    with folder.work() if folder else nullcontext():
        name = stego_name(stego)
        there = folder.write({name: with_extras(stego, cover, model)}) if folder else None
        as_read = read_model(there / name) if there else stego
        if [HiddenFile.of(open_payload(as_read, key)) for key in keys] != hidden:
            raise RuntimeError("the hidden files do not open again from the published file")
    return HideFilesResult(None if dry_run else stego, psnr_between(model, stego))


def _check_sizes(channel: Channel, cover: Gaussians, payloads: Sequence[Payload]) -> None:
    """Raise UsageError for payloads that fit in no cover of this size, before the cover is examined."""
    if channel.grows:
        return
    typical = channel.estimate_capacity(len(cover), cover.sh_degree).bytes
    size = sum(len(payload.data) for payload in payloads)
    if size > _MOST * typical:  # compressing takes longer
        size = sum(compressed_size(payload.data) for payload in payloads)
    if size > _MOST * typical:
        raise UsageError(
            f"the {channel.place} of a cover of {len(cover):,} Gaussians hold about {typical:,} bytes; the "
            f'given take {size:,}; `publish="converted", channel="appended"` has room for all'
        )


def _read(secret: SecretFile) -> HiddenFile:
    """Read the file. Raises InputError if it is missing or too large."""
    if isinstance(secret.file, bytes):
        return HiddenFile(secret.name, secret.file)
    path = Path(secret.file)
    return HiddenFile(secret.name or as_text(path.name), read_file(path, MAX_PAYLOAD_BYTES))
