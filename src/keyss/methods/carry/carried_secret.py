"""A carried secret, opened from its payload."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from functools import cached_property

from keyss.channels import Payload
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.methods.codec.model_bytes import decode
from keyss.methods.hidden import Frame, HiddenScene, Recovered


@dataclass(frozen=True)
class CarriedSecret(HiddenScene):
    """A carried secret."""

    payload: Payload
    frame = None

    @staticmethod
    def of(payload: Payload) -> CarriedSecret:
        """Read a payload. Raises InputError for damage."""
        secret = CarriedSecret(payload)
        _ = secret.gaussians
        return secret

    @cached_property
    def gaussians(self) -> Gaussians:
        """Decoded when it is first needed: until then, a secret takes a fifth of the memory."""
        return decode(self.payload.data, self.payload.model_size)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """All Gaussians of the secret."""
        if force:
            warnings.warn(
                "`force=True` has no effect: this secret opens whole or not at all",
                KeyssWarning,
                stacklevel=2,
            )
        if frame == "cover":
            raise UsageError(
                'a carried secret has no position in the cover\'s coordinates: leave out `frame="cover"`'
            )
        return self.gaussians

    def recovered(self, revealed: Gaussians) -> Recovered:
        return Recovered(len(revealed), len(revealed), self.payload.shards)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.gaussians.means.numpy().tobytes()).hexdigest()[:16]
