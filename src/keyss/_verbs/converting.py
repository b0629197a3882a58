"""`convert`: a model in another format, and what that costs the model and what is hidden in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from keyss._verbs.filing import open_file_in
from keyss.core.errors import InputError, KeyssError, QualityError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.atomic import write_bytes
from keyss.files.models import (
    check_model_output,
    keeps_low_bits,
    model_bytes,
    model_of_bytes,
)
from keyss.files.streams import StandardOutput, is_standard
from keyss.rendering import Backend, resolve_device
from keyss.rendering.difference import cost
from keyss.runs.config import PathLike
from keyss.runs.folder import check_not_published
from keyss.runs.opening import as_model
from keyss.runs.revealing import reveal_model

# Below this share of a secret's Gaussians it counts as destroyed.
_KEPT = 0.99


@dataclass(frozen=True)
class KeptSecret:
    """How much of a secret opens with its key, before and after the conversion."""

    before: int  # Gaussians, or bytes of a hidden file
    after: int
    unit: str = "Gaussians"

    @property
    def kept(self) -> bool:
        return self.after >= _KEPT * self.before


@dataclass(frozen=True)
class Conversion:
    """A model in another format."""

    gaussians: Gaussians  # as they are read from it
    bytes_before: int | None  # None: from standard input, or from memory
    bytes_after: int
    psnr: float  # dB between pictures of the model before and after, from around it; 120: they are the same
    keeps_low_bits: bool  # whether the format does
    secrets: tuple[KeptSecret, ...]  # of the keys, in their order


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
    """Write a model in the format that the suffix of `out` names, and measure what that costs.

    What each of `keys` opens in `model` has to open from what is to be written as well: else QualityError is
    raised and nothing is written, unless with `force`. `dry_run` writes nothing at all. Without keys nothing
    is looked for, and nothing that comes back says whether anything is hidden. Raises WrongKeyError for a key
    that opens nothing, InputError, OutputError, and UsageError for an unknown suffix.
    """
    target = resolve_device(device)
    source = None if isinstance(model, Gaussians) else Path(model)
    path = check_model_output(out, overwrite, [source] if source else [])
    if not is_standard(path):
        check_not_published(path)
    before = as_model(model)
    opened = [_opened(before, key, target) for key in keys]
    data = model_bytes(path, before)
    after = model_of_bytes(path, data)
    secrets = tuple(
        KeptSecret(count, _left(after, key, target), unit)
        for key, (count, unit) in zip(keys, opened, strict=True)
    )
    size = None if source is None or is_standard(source) else source.stat().st_size
    psnr = cost(before.to(target), after.to(target))
    result = Conversion(after, size, len(data), psnr, keeps_low_bits(path), secrets)
    lost = [number for number, each in enumerate(secrets, 1) if not each.kept]
    if lost and not (force or dry_run):
        raise QualityError(_refusal(path, result, lost))
    if dry_run:
        return result
    if is_standard(path):
        StandardOutput().write(memoryview(data))
    else:
        write_bytes(path, data)
    return result


def _opened(model: Gaussians, key: str, device: torch.device) -> tuple[int, str]:
    """How much a key opens: Gaussians of a scene, or bytes of a file. Raises WrongKeyError, InputError."""
    try:
        return reveal_model(model, key, device=device).remains.found, "Gaussians"
    except (InputError, WrongKeyError) as error:
        try:
            return len(open_file_in(model, key).data), "bytes"
        except KeyssError:
            raise error from None


def _left(model: Gaussians, key: str, device: torch.device) -> int:
    """How much a key opens in a converted model."""
    try:
        return _opened(model, key, device)[0]
    except (WrongKeyError, InputError, UsageError):
        return 0


def _refusal(path: Path, result: Conversion, lost: Sequence[int]) -> str:
    """Why nothing was written."""
    first = result.secrets[lost[0] - 1]
    which = "the secret that the key opens" if len(result.secrets) == 1 else f"the secret of key {lost[0]}"
    left = f"{first.after:,} of its {first.before:,} {first.unit} would open from {path}"
    why = (
        ""
        if result.keeps_low_bits
        else ": the bits that hold it do not survive writing the model in that format"
    )
    return f"{which} would be lost: {left}{why}; nothing was written; `force=True` writes it all the same"
