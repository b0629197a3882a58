"""The capacity of a cover for secrets, and the secrets that fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from keyss.channels import APPENDED, Capacity, Channel, PreparedCover
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.methods.carry.carry_options import CarryOptions
from keyss.methods.codec.precision import finest_size, prune_to_size, usual_size
from keyss.rendering.orbit import Viewpoints

_BITS_PER_GAUSSIAN = 150, 210  # of a secret that is not fitted yet, with the usual and the finest precision
_SAMPLE, _FAR_TOO_LARGE = 10_000, 1.5  # Gaussians; times what can be appended
_TINY = 16  # Gaussians; secrets are not pruned to fewer
_ANY = '`publish="converted"` has room for all'


@dataclass(frozen=True)
class SecretSize:
    """The size of a secret, at most if it is not fitted yet."""

    count: int
    model: Gaussians | None = None  # None: not fitted yet

    @staticmethod
    def of(model: Gaussians) -> SecretSize:
        return SecretSize(len(model), model)

    @property
    def payload_bytes(self) -> tuple[int, int]:
        """Bytes of the secret as a payload, with the usual and the finest precision."""
        if self.model is None:
            usual, finest = (self.count * each // 8 for each in _BITS_PER_GAUSSIAN)
            return usual, finest
        return usual_size(self.model), finest_size(self.model)

    def check_appended(self) -> None:
        """Raise UsageError for a secret far too large for appended Gaussians, by a sample of it.

        A sparse sample takes more bits for positions: log2 of the distance between its Gaussians.
        """
        step, most = self.count // _SAMPLE, APPENDED.estimate_capacity(0, 0).bytes
        if self.model is None or step < 2:
            return
        sample = self.model[::step]
        size = self.count * (usual_size(sample) / len(sample) - math.log2(step) / 8)
        if size > _FAR_TOO_LARGE * most:
            raise UsageError(
                f"the secret takes about {size:,.0f} bytes, and {most:,} can be "
                "appended; fewer Gaussians or a lower SH degree take less"
            )


@dataclass(frozen=True)
class CarryCapacity:
    """The capacity of a cover: exact for a prepared cover, estimated for one not fitted yet."""

    gaussians: int  # Gaussians of the cover
    sh_degree: int  # SH degree of the published model
    channel: Channel
    payloads: Capacity
    prepared: PreparedCover | None = None  # None: not fitted yet

    @staticmethod
    def of(cover: Gaussians | None, options: CarryOptions) -> CarryCapacity:
        """The capacity of `cover`. Raises UsageError for a cover without capacity."""
        channel = options.channel_in(cover)
        try:
            if cover is None:
                count, degree = options.fit.max_gaussians, options.fit.sh_degree
                return CarryCapacity(count, degree, channel, channel.estimate_capacity(count, degree))
            prepared = channel.prepare(cover)
        except UsageError as error:
            if channel.survives:
                raise
            raise UsageError(f"{error}; {_ANY}") from error
        return CarryCapacity(len(cover), cover.sh_degree, channel, prepared.capacity, prepared)

    def sizes(self, secrets: Sequence[SecretSize]) -> list[int]:
        """The number of Gaussians of each secret that fit; an estimate where not all do.

        Raises UsageError if the cover is too small.
        """
        limits = self.payloads.limits([secret.payload_bytes[1] for secret in secrets])
        counts = [
            min(secret.count, secret.count * limit // secret.payload_bytes[0])
            for secret, limit in zip(secrets, limits, strict=True)
        ]
        if any(count < min(_TINY, secret.count) for count, secret in zip(counts, secrets, strict=True)):
            raise UsageError(
                f"a cover of {self.gaussians:,} Gaussians is too small to hide {len(secrets)} "
                f"{'secrets' if len(secrets) > 1 else 'secret'} in its {self.channel.place}; "
                + ('`channel="appended"` has room for all' if self.channel.survives else _ANY)
            )
        return counts

    def prune(self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]) -> list[Gaussians]:
        """The most visible Gaussians of each model that fit, or all; see `prune_to_size`.

        Warns (KeyssWarning) if the models have less room than they would alone.
        """
        needed = list(map(finest_size, models))
        self.payloads.warn_of_sharing(needed)
        limits = self.payloads.limits(needed)
        return [prune_to_size(*each) for each in zip(models, limits, viewpoints, strict=True)]

    def appended(self, secrets: Sequence[SecretSize]) -> int:
        """Approximate number of Gaussians by which the model grows."""
        if not self.payloads.grows:
            return 0
        return APPENDED.appended_count([secret.payload_bytes[0] for secret in secrets])
