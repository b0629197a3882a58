"""Opening a secret again in a model that was changed, as the holder of its key would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.registry import open_model


@dataclass(frozen=True)
class Opened:
    """A secret as it was revealed."""

    gaussians: Gaussians  # in the secret's own frame
    frame: Similarity = field(default_factory=Similarity.identity)  # from there into the cover's


# Raises a KeyssError when the secret cannot be opened.
Reopen = Callable[[Gaussians], Opened]


@dataclass(frozen=True)
class Reopener:
    """`reopener(stego)` is what `keyss reveal` gives, with `--force` where the model asks for it."""

    key: str = field(repr=False)
    sidecar: bytes | None = field(default=None, repr=False)

    def __call__(self, stego: Gaussians) -> Opened:
        """Raises WrongKeyError and InputError as `open_model` and `open_secret` do."""
        stego = stego.to("cpu")
        secret = open_model(stego, self.key, sidecar=self.sidecar)
        try:
            revealed = secret.reveal(stego)
        except InputError:  # positions changed, so that it seems to be another model
            revealed = secret.reveal(stego, force=True)
        return Opened(revealed, secret.frame or Similarity.identity())
