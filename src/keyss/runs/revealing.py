"""From a published model and a key to a secret, and how much of it is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.reading import read_file
from keyss.methods import handed as handing, registry
from keyss.methods.opened import Frame, HiddenFile, Opened, OpensAFileError, Remains
from keyss.runs.sources import PathLike

# Pruning compensation makes up for the loss of nine tenths at most (`keyss.core.gaussians`): with
# less left, renders become emptier and emptier.
MIN_LEFT = 0.1
# A loss that is compensated.
NOTICED_LOSS = 0.01


@dataclass(frozen=True)
class Revealed:
    """The scene or the file that a key opened."""

    scene: Gaussians | None  # on the CPU
    remains: Remains  # of a file in bytes
    warnings: tuple[str, ...] = ()  # of missing Gaussians
    file: HiddenFile | None = None

    @property
    def gaussians(self) -> Gaussians:
        """The model of the scene. Raises UsageError if the key opens a file."""
        if self.scene is None:
            raise UsageError("this key opens a file, not a scene: see `file`")
        return self.scene

    def check_usable(self) -> None:
        """Raise InputError if so little is left that renders would be nearly empty."""
        if self.remains.share < MIN_LEFT:
            raise InputError(
                f"{_count(self.remains)}, too few to render (expected at least {MIN_LEFT:.0%}): the others "
                f"{_CAUSE}; use the file as it was published, or `force=True` to get the rest"
            )


_CAUSE = (
    "were removed from the published file or changed in it, as pruning by opacity, cropping, editing and "
    "converting do"
)


def reveal_model(
    model: Gaussians,
    key: str | None,
    *,
    device: torch.device,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
    handed: PathLike | None = None,
) -> Revealed:
    """What `key` opens in a stego model, however little is left; see `keyss.reveal`, also for errors."""
    if handed is not None:
        if decoy:
            raise UsageError("files that are handed over have no decoys: leave out `decoy=True`")
        opened = read_handed(handed, key)
    elif key is None:
        raise UsageError("expected `key`, or `handed` for a file that was handed over")
    else:
        opened = registry.open_model(model, key, decoy=decoy)
    revealed = opened.reveal(model.to(device), frame=frame, force=force)
    remains = opened.remains(revealed)
    return Revealed(revealed, remains, tuple(_loss(remains)))


def reveal_any(model: Gaussians, key: str, device: torch.device) -> Revealed:
    """The scene, however little is left, or the file that `key` opens in a model."""
    try:
        return reveal_model(model, key, device=device)
    except OpensAFileError as error:
        return revealed_file(error.file)


def revealed_file(file: HiddenFile) -> Revealed:
    """The result for a hidden file, which is always whole."""
    return Revealed(None, Remains(len(file.data), len(file.data)), file=file)


def _loss(remains: Remains) -> list[str]:
    """A warning for a secret that is not whole."""
    if remains.share < 1 - NOTICED_LOSS:
        return [
            f"{_count(remains)}: the others {_CAUSE}; the rest was made larger and denser to compensate; the "
            "file as it was published gives the whole secret"
        ]
    if remains.share > 1 + NOTICED_LOSS:
        return [f"{_count(remains)}: Gaussians were copied or changed in the published file"]
    return []


def _count(remains: Remains) -> str:
    if not remains.hidden:
        return f"{remains.found:,} Gaussians of the secret were found"
    return f"{remains.found:,} of {remains.hidden:,} Gaussians of the secret were found"


def read_handed(path: PathLike, key: str | None) -> Opened:
    """Open the secret in a file that was handed over; see `registry.open_handed`."""
    data = read_file(Path(path), handing.MAX_BYTES)
    try:
        return registry.open_handed(data, key)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def is_sealed(path: PathLike) -> bool:
    """True if a file that was handed over needs a key. Raises InputError."""
    return handing.is_sealed(read_file(Path(path), handing.MAX_BYTES))
