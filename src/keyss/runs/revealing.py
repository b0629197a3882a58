"""From a published model and a key to a secret: where it is looked for, and how much of it is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.reading import read_file
from keyss.methods import handed as handing, registry
from keyss.methods.hidden_file import HiddenFile, OpensAFileError
from keyss.methods.opened import Frame, Opened, Remains
from keyss.runs.sources import PathLike

# Pruning compensation makes up for nine tenths at most (`keyss.core.pruning_compensation`): below that the
# pictures of what is left get emptier and emptier.
MIN_LEFT = 0.1
# A loss that compensation takes notice of.
NOTICED_LOSS = 0.01


@dataclass(frozen=True)
class Revealed:
    """What a key opened: a scene or a file."""

    scene: Gaussians | None  # on the CPU
    remains: Remains  # of a file in bytes
    warnings: tuple[str, ...] = ()  # what is missing and why
    file: HiddenFile | None = None

    @property
    def gaussians(self) -> Gaussians:
        """The model of the scene. Raises UsageError if the key opens a file."""
        if self.scene is None:
            raise UsageError("this key opens a file, not a scene: see `file`")
        return self.scene

    def check_usable(self) -> None:
        """Raise InputError if so little is left that its pictures would be all but empty."""
        if self.remains.share < MIN_LEFT:
            raise InputError(
                f"{_count(self.remains)}, too little to be seen (at least {MIN_LEFT:.0%} expected): the "
                f"others {_CAUSE}; take the file as it was published, or `force=True` gives what there is"
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
    """What `key` opens in a stego model, however little it is; see `keyss.reveal`, also for errors."""
    if handed is not None:
        if decoy:
            raise UsageError("there are no decoys of what was handed over: leave out `decoy=True`")
        opened = read_handed(handed, key)
    elif key is None:
        raise UsageError("nothing to open it with: give `key`, or `handed` for a file that was handed over")
    else:
        opened = registry.open_model(model, key, decoy=decoy)
    revealed = opened.reveal(model.to(device), frame=frame, force=force)
    remains = opened.remains(revealed)
    return Revealed(revealed, remains, tuple(_loss(remains)))


def reveal_any(model: Gaussians, key: str, device: torch.device) -> Revealed:
    """What `key` opens in a model: a scene, however little is left of it, or a file."""
    try:
        return reveal_model(model, key, device=device)
    except OpensAFileError as error:
        return revealed_file(error.file)


def revealed_file(file: HiddenFile) -> Revealed:
    """A hidden file, which is revealed whole or not at all."""
    return Revealed(None, Remains(len(file.data), len(file.data)), file=file)


def _loss(remains: Remains) -> list[str]:
    """What to tell a person whose secret is not whole, if anything."""
    if remains.share < 1 - NOTICED_LOSS:
        return [
            f"{_count(remains)}: the others {_CAUSE}; those left were made larger and denser to make up for "
            "them; the file as it was published gives the whole secret"
        ]
    if remains.share > 1 + NOTICED_LOSS:
        return [f"{_count(remains)}: Gaussians were copied or changed in the published file"]
    return []


def _count(remains: Remains) -> str:
    if not remains.hidden:
        return f"{remains.found:,} Gaussians of the secret were found"
    return f"{remains.found:,} of {remains.hidden:,} Gaussians of the secret were found"


def read_handed(path: PathLike, key: str | None) -> Opened:
    """The secret in a file that was handed over; see `registry.open_handed`."""
    data = read_file(Path(path), handing.MAX_BYTES)
    try:
        return registry.open_handed(data, key)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def is_sealed(path: PathLike) -> bool:
    """Whether it takes a key to open a file that was handed over. Raises InputError."""
    return handing.is_sealed(read_file(Path(path), handing.MAX_BYTES))
