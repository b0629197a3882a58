"""`convert`: write a model in another format, and measure the loss for the model and its secrets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from keyss.channels import SUFFIXES
from keyss.core.errors import InputError, QualityError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import mode_like, write_bytes
from keyss.files.file_kinds import model_file
from keyss.files.formats.ply import with_extras
from keyss.files.inputs import is_standard, write_standard_output
from keyss.files.models import check_model_output, keeps_low_bits, model_bytes, model_of_bytes, reads_as
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_visible, psnr_between
from keyss.runs.files import PathLike, as_model, is_published
from keyss.runs.folder import check_not_published
from keyss.runs.revealing import reveal_secret

_KEPT = 0.99  # share; a secret with fewer Gaussians left counts as lost


@dataclass(frozen=True)
class KeptSecret:
    """Size of a secret that its key opens before and after the conversion."""

    before: int  # Gaussians, or bytes of a hidden file
    after: int
    unit: str = "Gaussians"

    @property
    def kept(self) -> bool:
        return self.after >= _KEPT * self.before


@dataclass(frozen=True)
class Conversion:
    """A model in another format."""

    gaussians: Gaussians  # read back from the converted file
    bytes_before: int | None  # None: read from standard input or from memory
    bytes_after: int
    psnr: float  # dB between renders before and after, from all around; 120: equal; NaN: empty
    keeps_low_bits: bool  # whether the format keeps them
    secrets: tuple[KeptSecret, ...]  # one per key, in order


@torch.no_grad()
def convert(
    model: PathLike | Gaussians,
    out: PathLike,
    keys: Sequence[str] = (),
    *,
    force: bool = False,
    dry_run: bool = False,
    overwrite: bool = False,
    device: Backend = "auto",
) -> Conversion:
    """Write a model in the format of the suffix of `out`, and measure the loss.

    Without `force`, raises QualityError and writes nothing if a secret that one of `keys` opens would be
    lost, or if `model` is the published file of a run and there are no keys to check that. The file gets the
    permissions of `model`. `dry_run` writes nothing at all. Without keys, the result does not reveal whether
    something is hidden. Raises WrongKeyError for a key that opens nothing, InputError, OutputError, and
    UsageError for an unknown suffix.
    """
    target = resolve_device(device)
    source = None if isinstance(model, Gaussians) else model_file(model)
    path = check_model_output(out, overwrite, [source] if source else [])
    if not is_standard(path):
        check_not_published(path)
    if source and not (keys or force or dry_run) and not keeps_low_bits(path) and is_published(source):
        raise QualityError(
            f"{source} was published with a secret, which this format may destroy: give its `keys` to "
            "check, or convert the model without it: `force=True`; nothing was written"
        )
    before = as_model(model if source is None else source)
    opened = [reveal_secret(before, key, target) for key in keys]
    data = model_bytes(path, with_extras(before, source, before))
    after = before if reads_as(path, before, data) else model_of_bytes(path, data)  # a copy takes memory
    secrets = tuple(
        KeptSecret(
            secret.recovered.found, _size_left(after, key, target), "bytes" if secret.file else "Gaussians"
        )
        for key, secret in zip(keys, opened, strict=True)
    )
    size = None if source is None or is_standard(source) else source.stat().st_size
    psnr = psnr_between(before.to(target), after.to(target)) if is_visible(before.to(target)) else math.nan
    result = Conversion(after, size, len(data), psnr, keeps_low_bits(path), secrets)
    lost = [number for number, secret in enumerate(secrets, 1) if not secret.kept]
    if lost and not (force or dry_run):
        raise QualityError(_refusal(path, result, lost))
    if dry_run:
        return result
    if is_standard(path):
        write_standard_output(data)
    else:
        mode = 0o600 if source is None or is_standard(source) else mode_like(source)
        write_bytes(path, data, mode)
    return result


def _size_left(model: Gaussians, key: str, device: torch.device) -> int:
    """Gaussians or bytes of the secret that survived the conversion; 0 if none did."""
    try:
        return reveal_secret(model, key, device).recovered.found
    except (WrongKeyError, InputError, UsageError):
        return 0


def _refusal(path: Path, result: Conversion, lost: Sequence[int]) -> str:
    """The message if nothing was written."""
    first = result.secrets[lost[0] - 1]
    which = "the secret that the key opens" if len(result.secrets) == 1 else f"the secret of key {lost[0]}"
    left = f"{first.after:,} of its {first.before:,} {first.unit} would be left in {path}"
    why = "" if result.keeps_low_bits else ", as this format destroys low bits"
    formats = [name for name, suffix in SUFFIXES.items() if path.name.lower().endswith(suffix)]
    cures = ['`publish="converted"`', *(f'`format="{name}"`' for name in formats)]
    return (
        f"{which} would be lost: {left}{why}; nothing was written; hide it by the method carry with "
        f"{' or '.join(cures)}, or convert the model without it: `force=True`"
    )
