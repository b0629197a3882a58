"""Opening a secret again in a model that was changed, as the holder of its key would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.similarity import Similarity
from keyss.methods.carry.carrying import Carried
from keyss.methods.learned.opening import open_model
from keyss.methods.learned.payload import HiddenSecret
from keyss.methods.learned.revealing import open_secret, reveal_gaussians


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
        secret: Carried | HiddenSecret
        if self.sidecar is None:
            secret = open_model(stego, self.key)
        else:
            secret = open_secret(stego, self.key, self.sidecar)
        if isinstance(secret, Carried):
            return Opened(compensate_pruning(secret.gaussians, secret.count))
        try:
            revealed = reveal_gaussians(stego, secret)
        except InputError:  # positions changed, so that it seems to be another model
            revealed = reveal_gaussians(stego, secret, force=True)
        return Opened(revealed, secret.frame)
