"""The capacity of a cover for secrets, and the secrets that fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from keyss.channels import APPENDED, Capacity, Channel, PreparedCover
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.fitting.config import FitConfig
from keyss.methods.codec.precision import finest_size, prune_to_size, usual_size
from keyss.rendering.orbit import Viewpoints

_BITS_PER_GAUSSIAN = 150, 210  # of a secret that is not fitted yet, with the usual and the finest precision
_FLAT_BITS = 90  # bits of an unfitted Gaussian of SH degree 0, with the usual precision
_SAMPLE, _FAR_TOO_LARGE = 10_000, 1.5  # Gaussians of a sample; size / what can be appended
_TINY = 16  # Gaussians; secrets are not pruned to fewer


@dataclass(frozen=True)
class SecretSize:
    """The size of a secret, at most if it is not fitted yet."""

    count: int  # Gaussians
    usual: int  # bytes of its payload with the usual precision
    finest: int
    sh_degree: int
    model: Gaussians | None  # None: not fitted yet

    @staticmethod
    def of(model: Gaussians | None, fit: FitConfig) -> SecretSize:
        """The size of `model`, or of what `fit` will give."""
        if model is not None:
            return SecretSize(len(model), usual_size(model), finest_size(model), model.sh_degree, model)
        usual, finest = (fit.max_gaussians * bits // 8 for bits in _BITS_PER_GAUSSIAN)
        return SecretSize(fit.max_gaussians, usual, finest, fit.sh_degree, None)

    @property
    def flat(self) -> int:
        """Like `usual`, at SH degree 0; takes as long again for large models."""
        if self.model is None:
            return self.count * _FLAT_BITS // 8
        return usual_size(self.model.with_sh_degree(0))


def check_appended(model: Gaussians) -> None:
    """Raise UsageError for a secret far too large for appended Gaussians, by a sample of it.

    A sparse sample takes more bits for positions: log2 of the distance between its Gaussians.
    """
    step, most = len(model) // _SAMPLE, APPENDED.estimate_capacity(0, 0).bytes
    if step < 2:
        return
    sample = model[::step]
    size = len(model) * (usual_size(sample) / len(sample) - math.log2(step) / 8)
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
    def of(channel: Channel, cover: Gaussians | None, fit: FitConfig) -> CarryCapacity:
        """The capacity of `cover`, or of what `fit` will give. Raises UsageError if there is none."""
        if cover is None:
            size = fit.max_gaussians, fit.sh_degree
            return CarryCapacity(*size, channel, channel.estimate_capacity(*size))
        prepared = channel.prepare(cover)
        return CarryCapacity(len(cover), cover.sh_degree, channel, prepared.capacity, prepared)

    def sizes(self, secrets: Sequence[SecretSize], *, flat: bool = False) -> list[int]:
        """The number of Gaussians of each secret that fit; an estimate where not all do.

        They keep their SH degree or, if `flat`, have degree 0.

        Raises UsageError if the cover is too small.
        """
        limits = self.payloads.limits([secret.finest for secret in secrets])
        counts = [
            min(secret.count, secret.count * limit // (secret.flat if flat else secret.usual))
            for secret, limit in zip(secrets, limits, strict=True)
        ]
        if any(count < min(_TINY, secret.count) for count, secret in zip(counts, secrets, strict=True)):
            raise UsageError(
                f"a cover of {self.gaussians:,} Gaussians is too small to hide {len(secrets)} "
                f"{'secrets' if len(secrets) > 1 else 'secret'} in its {self.channel.place}"
            )
        return counts

    def prune(self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]) -> list[Gaussians]:
        """The most visible Gaussians of each model that fit, or all; see `prune_to_size`.

        Warns (KeyssWarning) if the models have less room than they would alone.
        """
        needed = list(map(finest_size, models))
        self.payloads.warn_of_sharing(needed)
        limits = self.payloads.limits(needed)
        return [prune_to_size(*model) for model in zip(models, limits, viewpoints, strict=True)]
