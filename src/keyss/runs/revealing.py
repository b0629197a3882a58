"""From a published model and a key to a secret: where it is looked for, and how much of it is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import torch

from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Frame, Opened, Remains
from keyss.methods.decoy import Decoy
from keyss.runs.config import PathLike
from keyss.runs.opening import open_file

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
    from_sidecar: bool  # rather than out of the model itself
    warnings: tuple[str, ...]  # sentences: what is missing and why, a sidecar that was passed over

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

    decoder: PathLike | bytes | None
    frame: Frame
    decoy: bool
    force: bool


def reveal_model(
    model: Gaussians,
    key: str,
    *,
    device: torch.device,
    decoder: PathLike | bytes | None = None,
    beside: Path | None = None,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
) -> RevealResult:
    """What `key` opens in a stego model or in its sidecar, however little it is; see `keyss.api.reveal`.

    A `decoder` that is given has to open. A sidecar `beside` the model's file that does not open, or that
    belongs to another model, gives way to what lies in the model's low bits. Raises as `keyss.api.reveal`
    does.
    """
    if beside is None or decoder is not None:
        opened, passed_over = open_file(model, key, decoder, decoy=decoy), None
    else:
        opened, passed_over = _open_beside(model, key, beside, decoy=decoy, force=force)
    revealed = opened.reveal(model.to(device), frame=frame, force=force)
    remains = opened.remains(revealed)
    # With a decoy nothing may tell a right key from a wrong one, and a wrong one passes over every sidecar.
    said = [] if passed_over is None or decoy else [passed_over]
    from_sidecar = not (decoder is None and beside is None) and passed_over is None
    return RevealResult(revealed, remains, from_sidecar, (*said, *_loss(remains)))


def _open_beside(
    stego: Gaussians, key: str, beside: Path, *, decoy: bool, force: bool
) -> tuple[Opened, str | None]:
    """What the key decrypts in the sidecar, or else in the low bits; and why the sidecar was passed over.

    With `decoy` both are looked at whatever the first one gives, so that every key makes the same work.
    """
    sealed: Opened | None = None
    problem: WrongKeyError | InputError | None = None
    try:
        sealed = open_file(stego, key, beside)
        sealed.check_belongs_to(stego)
    except (WrongKeyError, InputError) as error:
        problem = error
    if sealed is not None and problem is None and not decoy:
        return sealed, None
    own: Opened | None = None
    refusal: WrongKeyError | InputError | None = None
    try:
        own = open_file(stego, key, None, decoy=decoy)
    except (WrongKeyError, InputError) as error:
        refusal = error
    if sealed is not None and problem is None:
        return sealed, None
    assert problem is not None
    if own is not None and not isinstance(own, Decoy):
        why = "this key does not open it"
        if isinstance(problem, InputError):
            why = str(problem).removeprefix(f"{beside}: ").partition(": ")[0]
        return own, f"{beside} was passed over ({why}); what lies in the model itself was opened"
    if sealed is not None and force:
        return sealed, None
    if own is not None and isinstance(problem, WrongKeyError):
        return own, None  # a decoy
    raise refusal if isinstance(refusal, InputError) else problem


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
