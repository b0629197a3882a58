"""The capacity of a cover for secrets: records of Gaussians in low bits, or a payload per secret."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from keyss.channels import (
    APPENDED,
    LOW_BITS,
    TYPICAL_SHARE,
    Capacity,
    Channel,
    Layout,
    LowBitsCapacity,
    LowBitsCover,
    PreparedCover,
    RecordRequest,
)
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import expand
from keyss.methods.base import divide
from keyss.methods.carry.options import CarryOptions
from keyss.methods.records.carried_secret import COUNT
from keyss.methods.records.lines import Table
from keyss.methods.records.precision import most_visible, prune_to_size
from keyss.methods.records.quantise import Codec
from keyss.methods.records.whole import encode
from keyss.rendering.orbit import Viewpoints

_BITS_PER_GAUSSIAN = 150  # payload estimate for a secret that is not fitted yet
_FAINT = 1e-3  # standard deviation of added harmonics
_TINY = 16  # Gaussians; secrets are not pruned to fewer
_ANY = '`publish="any"` has room for all'


@dataclass(frozen=True)
class SecretSize:
    """The size of a secret, or its maximum size if it is not fitted yet."""

    count: int
    sh_degree: int
    model: Gaussians | None = None  # None: not fitted yet

    @staticmethod
    def of(model: Gaussians) -> SecretSize:
        return SecretSize(len(model), model.sh_degree, model)

    @property
    def size(self) -> tuple[int, int]:
        """Gaussians and SH degree."""
        return self.count, self.sh_degree

    @cached_property
    def payload_bytes(self) -> int:
        """Bytes of the secret as a payload."""
        return self.count * _BITS_PER_GAUSSIAN // 8 if self.model is None else len(encode(self.model))


def _check_not_tiny(
    counts: Sequence[int], secrets: Sequence[SecretSize], cover: int, place: str, alternative: str
) -> None:
    """Raise UsageError if fewer than _TINY Gaussians of a secret fit into a cover of `cover` Gaussians."""
    if any(count < min(_TINY, secret.count) for count, secret in zip(counts, secrets, strict=True)):
        raise UsageError(
            f"a cover of {cover:,} Gaussians is too small to hide {len(secrets)} "
            f"{'secrets' if len(secrets) > 1 else 'secret'} in its {place}; {alternative}"
        )


@dataclass(frozen=True)
class RecordCapacity:
    """The capacity for records in low bits: exact for a prepared cover, estimated for one not fitted yet."""

    gaussians: int  # Gaussians of the cover
    sh_degree: int  # SH degree of the cover
    cells: LowBitsCapacity
    prepared: LowBitsCover | None = None  # None: not fitted yet
    refit_share = 1.0  # refit size / Gaussians that fit

    @staticmethod
    def of(cover: Gaussians | None, options: CarryOptions, entropy: bytes | None = None) -> RecordCapacity:
        """The capacity of `cover` after the change of harmonics in `options`.

        Raises UsageError if a record does not fit into a Gaussian, and if low bits are not random.
        """
        try:
            return RecordCapacity._of(cover, options, os.urandom(32) if entropy is None else entropy)
        except UsageError as error:
            raise UsageError(f"{error}; {_ways(cover, options)}") from error

    @staticmethod
    def _of(cover: Gaussians | None, options: CarryOptions, entropy: bytes) -> RecordCapacity:
        degree, count = options.fit.sh_degree, options.fit.max_gaussians
        if cover is not None:
            cover = to_degree(cover, degree, entropy)
        layout = Layout(degree) if cover is None else Layout.of(cover)
        if largest_degree(LowBitsCapacity(0, layout.width).record_bytes(1)) is None:
            unit = "" if layout.quats else " with unit quaternions"
            raise UsageError(f"a cover of SH degree {degree}{unit} has no room for anything in its low bits")
        if cover is None:
            return RecordCapacity(count, degree, LowBitsCapacity(int(TYPICAL_SHARE * count), layout.width))
        prepared = LOW_BITS.prepare(cover)
        return RecordCapacity(len(cover), degree, prepared.cells, prepared)

    @property
    def cover(self) -> Gaussians | None:
        """The cover before embedding."""
        return None if self.prepared is None else self.prepared.cover

    @property
    def max_secret_degree(self) -> int:
        """The maximum SH degree of secrets whose records fit into a Gaussian."""
        return largest_degree(self.cells.record_bytes(1)) or 0

    def sizes(self, secrets: Sequence[SecretSize]) -> list[tuple[int, int]]:
        """Gaussians and SH degree that fit for each secret, at most its own.

        Raises UsageError if the cover is too small.
        """
        counts = [secret.count for secret in secrets]
        degrees = [min(secret.sh_degree, self.max_secret_degree) for secret in secrets]
        requests = [record_request(*size) for size in zip(counts, degrees, strict=True)]
        capacity = self.cells.record_capacity(requests)
        if sum(counts) > capacity:
            # A key must not reveal whether there are other secrets, unless one of them would have no room.
            largest = max(request.least_bytes for request in requests)
            share = self.cells.max_independent_records(largest, len(secrets)) if len(secrets) > 1 else 0
            counts = [min(count, share) for count in counts] if share else divide(counts, capacity)
        place = f"low bits, {self.cells.carriers:,} of them random"
        _check_not_tiny(counts, secrets, self.gaussians, place, _ANY)
        return list(zip(counts, degrees, strict=True))

    def prune(self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]) -> list[Gaussians]:
        """The most visible Gaussians of each model that fit, or all."""
        return [
            most_visible(model.with_sh_degree(degree), count)
            for model, (count, degree) in zip(models, self.sizes([*map(SecretSize.of, models)]), strict=True)
        ]


@dataclass(frozen=True)
class PayloadCapacity:
    """The capacity for payloads: exact for a prepared cover, estimated for one not fitted yet."""

    gaussians: int  # Gaussians of the cover
    sh_degree: int  # SH degree of the published model
    channel: Channel
    payloads: Capacity
    cover: Gaussians | None = None  # before embedding; None: not fitted yet
    prepared: PreparedCover | None = None
    max_secret_degree = 3
    refit_share = 0.97  # refit size / Gaussians that fit: refitted Gaussians compress a little worse

    @staticmethod
    def of(cover: Gaussians | None, options: CarryOptions, channel: Channel) -> PayloadCapacity:
        """The capacity of `cover`. Raises UsageError for a cover without capacity."""
        degree, count = options.fit.sh_degree, options.fit.max_gaussians
        if cover is None:
            return PayloadCapacity(count, degree, channel, channel.estimate_capacity(count, degree))
        if cover.sh_degree > degree:
            cover = cover.with_sh_degree(degree)
        prepared = channel.prepare(cover)
        return PayloadCapacity(len(cover), cover.sh_degree, channel, prepared.capacity, cover, prepared)

    def sizes(self, secrets: Sequence[SecretSize]) -> list[tuple[int, int]]:
        """See `RecordCapacity.sizes`; an estimate for secrets that do not fit."""
        limits = shares(self.payloads, [secret.payload_bytes for secret in secrets])
        counts = [
            min(secret.count, secret.count * limit // secret.payload_bytes)
            for secret, limit in zip(secrets, limits, strict=True)
        ]
        alternative = '`channel="appended"` has room for all' if self.channel.survives else _ANY
        _check_not_tiny(counts, secrets, self.gaussians, self.channel.place, alternative)
        return [(count, secret.sh_degree) for count, secret in zip(counts, secrets, strict=True)]

    def prune(self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]) -> list[Gaussians]:
        """See `RecordCapacity.prune`; the SH degree is the one that renders most like the model."""
        limits = shares(self.payloads, [len(encode(model)) for model in models])
        return [prune_to_size(*each) for each in zip(models, limits, viewpoints, strict=True)]

    def appended(self, secrets: Sequence[SecretSize]) -> int:
        """Approximate number of Gaussians by which the model grows."""
        if not self.payloads.grows:
            return 0
        return APPENDED.appended_count([secret.payload_bytes for secret in secrets])


def capacity_for(
    cover: Gaussians | None, options: CarryOptions, entropy: bytes | None = None
) -> RecordCapacity | PayloadCapacity:
    """The capacity of a cover: exact for a fitted one, otherwise estimated.

    Raises UsageError for a cover without capacity.
    """
    place = options.place_in(cover)
    return (
        RecordCapacity.of(cover, options, entropy)
        if place.records
        else PayloadCapacity.of(cover, options, place)
    )


def _ways(cover: Gaussians | None, options: CarryOptions) -> str:
    """For messages: the least SH degree that gives `cover` capacity, and what always works."""
    for degree in range(options.fit.sh_degree + 1, 3):
        try:
            capacity = RecordCapacity._of(cover, options.with_fit(sh_degree=degree), os.urandom(32))
        except UsageError:
            continue
        if capacity.cells.carriers:
            return f"`sh_degree={degree}` makes room, {_ANY}"
    return _ANY


def to_degree(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` with harmonics of `sh_degree`; added ones are small random numbers.

    (Zeros have no low bits to replace.)
    """
    count = (sh_degree + 1) ** 2 - model.sh.shape[1]
    if count <= 0:
        return model.with_sh_degree(sh_degree) if count else model  # the same object was prepared before
    seed = int.from_bytes(expand(entropy, "carry/raised", 8), "little") >> 1
    generator = torch.Generator().manual_seed(seed)
    # Scale before rounding: products in single precision keep a trace of their factor.
    noise = _FAINT * torch.randn(len(model), count, 3, generator=generator, dtype=torch.float64)
    return replace(model, sh=torch.cat([model.sh, noise.to(model.sh)], dim=1))


def record_request(count: int, sh_degree: int) -> RecordRequest:
    """The request to a channel for a model of `count` Gaussians."""
    header_bytes = COUNT.size + Codec.packed_size(sh_degree)
    return RecordRequest(count, Table.floor(sh_degree).record_bytes, header_bytes)


def largest_degree(record_bytes: int) -> int | None:
    """The maximum SH degree of records of at most `record_bytes`; None if none fits."""
    return next((each for each in (3, 2, 1, 0) if Table.floor(each).record_bytes <= record_bytes), None)


def shares(capacity: Capacity, needed: Sequence[int]) -> list[int]:
    """Maximum bytes of each secret's payload, for secrets that need `needed` bytes.

    The first of a quarter, a half and all of the capacity that suffices: a secret's precision then does not
    depend on the others, and its key does not reveal them. Equal shares if these exceed the capacity, or if
    the model grows.
    """
    total = int(capacity.bytes * capacity.further ** (len(needed) - 1))
    parts = [
        next((each for each in (4, 2) if size <= total // each - capacity.overhead), 1) for size in needed
    ]
    if capacity.grows or sum(1 / each for each in parts) > 1:
        parts = [len(needed)] * len(needed)
    return [max(0, total // each - capacity.overhead) for each in parts]
