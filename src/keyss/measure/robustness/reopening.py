"""Opening a secret again in a model that was changed, as the holder of its key would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.base import Opened


@dataclass(frozen=True)
class Reopened:
    """A secret as it was revealed."""

    gaussians: Gaussians  # in the secret's own frame
    frame: Similarity = field(default_factory=Similarity.identity)  # from there into the cover's


# Raises a KeyssError when the secret cannot be opened.
Reopen = Callable[[Gaussians], Reopened]


@dataclass(frozen=True)
class Reopener:
    """`reopener(stego)` is what `keyss reveal` gives, with `--force` where the model asks for it."""

    key: str = field(repr=False)
    open: Callable[[Gaussians, str], Opened] = field(repr=False)  # stego model on the CPU, key

    def __call__(self, stego: Gaussians) -> Reopened:
        """Raises WrongKeyError and InputError as `open` does."""
        stego = stego.to("cpu")
        secret = self.open(stego, self.key)
        try:
            revealed = secret.reveal(stego)
        except InputError:  # positions changed, so that it seems to be another model
            revealed = secret.reveal(stego, force=True)
        return Reopened(revealed, secret.frame or Similarity.identity())
