"""Hide files in a model: the part of `hide` for secrets without photos or models."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from keyss.api.hide_arguments import HideResult, SecretFile
from keyss.channels import Channel, Payload, open_payload
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.formats.ply import with_extras
from keyss.files.inputs import as_text, read_file
from keyss.files.models import read_model, reads_as
from keyss.keys.encryption import MAX_PAYLOAD_BYTES, compressed_size
from keyss.methods.hidden import HiddenFile
from keyss.methods.method import MethodOptions
from keyss.progress import Reporter
from keyss.rendering.orbit import is_model, psnr_between
from keyss.runs.estimates import seconds_for
from keyss.runs.files import STEGOS, PathLike, as_3dgs_model, stego_name
from keyss.runs.folder import HIDE_FILES, RunFolder

_MOST = 10  # times the estimated capacity; no channel holds more


def hide_files(
    cover: PathLike | Scene | Gaussians,
    secrets: Sequence[SecretFile],
    options: MethodOptions,
    out: Path | None,
    overwrite: bool,
    dry_run: bool,
    reporter: Reporter,
) -> HideResult:
    """Hide files in a model, and open them again to check; see `keyss.hide`."""
    if isinstance(cover, Scene) or not is_model(cover):
        raise UsageError("hiding a file needs a model as the cover; `keyss fit` makes one from photos")
    folder, inputs = None, [cover, *(secret.file for secret in secrets)]
    if out is not None and not dry_run:
        paths = [Path(path) for path in inputs if isinstance(path, str | Path)]
        folder = RunFolder(out, HIDE_FILES, writes=STEGOS, inputs=paths, overwrite=overwrite)
    seconds = 0.0 if isinstance(cover, Gaussians) else seconds_for("hide a file", Path(cover))
    with reporter.waiting("hiding", seconds):
        files, model = [_read(secret) for secret in secrets], as_3dgs_model(cover, "the cover")
        keyed = [(secret.key, file.payload()) for secret, file in zip(secrets, files, strict=True)]

        def embed_in(channel: Channel) -> tuple[Gaussians, bool]:
            _check_sizes(channel, model, [payload for _, payload in keyed])
            return channel.prepare(model).embed(keyed), channel.survives

        stego, survives = options.in_channel(model, embed_in)
        with folder.work() if folder else nullcontext():
            published = stego
            if folder:
                name = stego_name(stego)
                path = folder.write({name: with_extras(stego, cover, model)}) / name
                published = stego if reads_as(path, stego) else read_model(path)
            if [HiddenFile.of(open_payload(published, secret.key)) for secret in secrets] != files:
                raise RuntimeError("the hidden files do not open again from the published file")
        psnr = psnr_between(model, stego)
    return HideResult(None if dry_run else stego, survives=survives, psnr=psnr)


def _check_sizes(channel: Channel, cover: Gaussians, payloads: Sequence[Payload]) -> None:
    """Raise UsageError for payloads that fit in no cover of this size, before the cover is examined."""
    capacity = channel.estimate_capacity(len(cover), cover.sh_degree)
    if capacity.grows:
        return
    typical = capacity.bytes
    size = sum(len(payload.data) for payload in payloads)
    if size > _MOST * typical:  # compressing takes longer
        size = sum(compressed_size(payload.data) for payload in payloads)
    if size > _MOST * typical:
        raise UsageError(
            f"a cover of {len(cover):,} Gaussians holds about {typical:,} bytes in the {channel.place}, and "
            f"the given files take {size:,}"
        )


def _read(secret: SecretFile) -> HiddenFile:
    """Read the file. Raises InputError if it is missing or too large."""
    if isinstance(secret.file, bytes):
        return HiddenFile(secret.name, secret.file)
    path = Path(secret.file)
    return HiddenFile(secret.name or as_text(path.name), read_file(path, MAX_PAYLOAD_BYTES))
