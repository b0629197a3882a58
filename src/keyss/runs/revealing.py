"""From a published model and a key to a secret: where it is looked for, and how much of it is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import torch

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Frame, Remains
from keyss.runs.config import PathLike
from keyss.runs.opening import open_in, read_handed

# Pruning compensation makes up for nine tenths at most (`keyss.core.pruning_compensation`): below that the
# pictures of what is left get emptier and emptier.
LEAST_LEFT = 0.1
# A loss that compensation takes notice of.
NOTICED_LOSS = 0.01


@dataclass(frozen=True)
class RevealResult:
    """A secret, and how much of it a model still gave."""

    gaussians: Gaussians  # on the CPU
    remains: Remains
    warnings: tuple[str, ...]  # sentences: what is missing and why

    def check_usable(self) -> None:
        """Raise InputError if so little is left that its pictures would be all but empty."""
        if self.remains.share < LEAST_LEFT:
            raise InputError(
                f"{_count(self.remains)}, too little to be seen (at least {LEAST_LEFT:.0%} expected): the "
                f"others {_CAUSE}; take the file as it was published, or `force=True` gives what there is"
            )


_CAUSE = (
    "were removed from the published file or changed in it, as pruning by opacity, cropping, editing and "
    "converting do"
)


class RevealOptions(TypedDict, total=False):
    """Those of `keyss.api.reveal` that `reveal_model` takes as they are."""

    frame: Frame
    decoy: bool
    force: bool
    handed: PathLike | None


def reveal_model(
    model: Gaussians,
    key: str | None,
    *,
    device: torch.device,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
    handed: PathLike | None = None,
) -> RevealResult:
    """What `key` opens in a stego model, however little it is; see `keyss.api.reveal`, also for errors."""
    if handed is not None:
        if decoy:
            raise UsageError("there are no decoys of what was handed over: leave out `decoy=True`")
        opened = read_handed(handed, key)
    elif key is None:
        raise UsageError("nothing to open it with: give `key`, or `handed` for a file that was handed over")
    else:
        opened = open_in(model, key, decoy=decoy)
    revealed = opened.reveal(model.to(device), frame=frame, force=force)
    remains = opened.remains(revealed)
    return RevealResult(revealed, remains, tuple(_loss(remains)))


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
