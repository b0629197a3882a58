"""Room for secrets in a cover: Gaussian by Gaussian in low bits, or each secret as one string of bytes."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from keyss.channels import LOW_BITS, TYPICAL_SHARE, Channel, LowBitsCover, PreparedCover, Room
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import expand
from keyss.methods.base import advising
from keyss.methods.carry.options import CarryOptions
from keyss.methods.dither import dither, raised, sampled
from keyss.methods.plan import Plan
from keyss.methods.points import divided
from keyss.methods.records.embedding import Embedded, embed_models, embed_whole, shares
from keyss.methods.records.encoding import (
    check_degrees,
    most_visible,
    record_degree,
    record_request,
)
from keyss.methods.records.precision import check_fits, least_bytes, pruned
from keyss.rendering.difference import Viewpoints

_BITS_OF_SECRETS = 130  # of one Gaussian of a secret that is still to be fitted
_FITTING = 0.97  # of the Gaussians that fit before a refit, which changes how well they compress
ANY = '`publish="any"` has room for all'
_OTHERS = '`prune_to_fit=True` leaves out the least visible, `refit="auto"` refits it'
_TINY = 16  # Gaussians; fewer are no secret


@dataclass(frozen=True)
class Wanted:
    """A secret that needs room, of a size that is known or the largest that it may get."""

    count: int
    sh_degree: int
    model: Gaussians | None = None  # None: still to be fitted

    @staticmethod
    def of(model: Gaussians) -> Wanted:
        return Wanted(len(model), model.sh_degree, model)

    @property
    def size(self) -> tuple[int, int]:
        """Gaussians and SH degree."""
        return self.count, self.sh_degree

    @cached_property
    def bytes(self) -> int:
        """Bytes of a whole model."""
        return self.count * _BITS_OF_SECRETS // 8 if self.model is None else least_bytes(self.model)


@dataclass(frozen=True)
class SecretRoom(ABC):
    """The room for secrets in one cover."""

    gaussians: int  # of the cover
    sh_degree: int  # of the published model

    @abstractmethod
    def sizes(self, secrets: Sequence[Wanted]) -> list[tuple[int, int]]:
        """Gaussians and SH degree that each secret can have; below what is wanted where room is short.

        Raises UsageError for a cover without room.
        """

    @abstractmethod
    def check(self, secrets: Sequence[Wanted]) -> None:
        """Raise UsageError if secrets whose models are known will not fit as they are."""

    @abstractmethod
    def embed(
        self,
        keys: Sequence[str],
        models: Sequence[Gaussians],
        viewpoints: Sequence[Viewpoints],
        entropy: bytes | None,
    ) -> Embedded:
        """The secrets in the cover, pruned where they do not fit. Raises ValueError without a cover."""

    def refit_sizes(
        self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]
    ) -> list[tuple[int, int]]:
        """`sizes` for secrets that are refitted, whose models are known."""
        return self.sizes(list(map(Wanted.of, models)))

    def plan(self, secrets: Sequence[Wanted]) -> Plan:
        """The published model and the room in it, before refits."""
        return Plan(
            gaussians=self.gaussians,
            sh_degree=self.sh_degree,
            asked=sum(each.count for each in secrets),
            capacity=sum(count for count, _ in self.sizes(secrets)),
        )


@dataclass(frozen=True)
class RecordRoom(SecretRoom):
    """The low bits of a cover, or of one of so many Gaussians that is still to be fitted."""

    carriers: int
    prepared: LowBitsCover | None = None

    @staticmethod
    def of(cover: Gaussians | None, options: CarryOptions, entropy: bytes | None = None) -> RecordRoom:
        degree, most = options.fit.sh_degree, options.fit.max_gaussians
        if record_degree(degree) is None:
            message = f"a model of SH degree {degree} has no room for anything in its low bits"
            raise UsageError(f"{message}; {_ways(cover, options)}")
        if cover is None:
            return RecordRoom(most, degree, int(TYPICAL_SHARE * most))
        try:
            prepared = _prepared(cover, options, entropy)
        except InputError as error:
            raise InputError(f"{error}; {_ways(cover, options)}") from error
        return RecordRoom(len(cover), degree, prepared.carriers, prepared)

    def sizes(self, secrets: Sequence[Wanted]) -> list[tuple[int, int]]:
        room = LOW_BITS.room(self.carriers, self.sh_degree)
        wanted = [each.count for each in secrets]
        requests = [record_request(*each.size) for each in secrets]
        largest = LOW_BITS.largest_record(self.sh_degree)
        if all(each.least_bytes <= largest for each in requests) and sum(wanted) <= room.record_capacity(
            requests
        ):
            return [each.size for each in secrets]  # also with more harmonics than the cover has
        degree = record_degree(self.sh_degree) or 0
        degrees = [min(each.sh_degree, degree) for each in secrets]
        requests = [record_request(*each) for each in zip(wanted, degrees, strict=True)]
        capacity = room.record_capacity(requests)
        counts = wanted
        if sum(wanted) > capacity:
            # No key should tell whether there are other secrets, unless that leaves one of them nothing.
            least = max(each.least_bytes for each in requests)
            each = room.unnoticed_records(least, len(secrets)) if len(secrets) > 1 else 0
            counts = [min(count, each) for count in wanted] if each else divided(wanted, capacity)
        if any(count < min(_TINY, each) for count, each in zip(counts, wanted, strict=True)):
            raise UsageError(
                f"a cover of {self.gaussians:,} Gaussians is too small to hide {len(secrets)} secret"
                f"{'s' if len(secrets) > 1 else ''} in its low bits, {self.carriers:,} of them random; {ANY}"
            )
        return list(zip(counts, degrees, strict=True))

    def check(self, secrets: Sequence[Wanted]) -> None:
        known = [each for each in secrets if each.model is not None]
        with advising(UsageError, f"{_OTHERS}, {ANY}"):
            check_degrees(self.sh_degree, [each.sh_degree for each in known])
            carriers = self.carriers if self.prepared else self.gaussians  # at best all
            requests = [record_request(*each.size) for each in known]
            if requests:
                LOW_BITS.room(carriers, self.sh_degree).plan_records(requests)

    def embed(
        self,
        keys: Sequence[str],
        models: Sequence[Gaussians],
        viewpoints: Sequence[Viewpoints],
        entropy: bytes | None,
    ) -> Embedded:
        if self.prepared is None:
            raise ValueError("the cover is still to be fitted")
        sizes = self.sizes(list(map(Wanted.of, models)))
        kept = [
            most_visible(model.with_sh_degree(degree), count)
            for model, (count, degree) in zip(models, sizes, strict=True)
        ]
        return embed_models(self.prepared, keys, kept, entropy=entropy)


@dataclass(frozen=True)
class WholeRoom(SecretRoom):
    """The room for whole payloads in a cover; an estimate without `prepared`, for a cover to be fitted."""

    channel: Channel
    room: Room
    prepared: PreparedCover | None = None

    @staticmethod
    def of(cover: Gaussians | None, options: CarryOptions) -> WholeRoom:
        fit, channel = options.fit, options.place
        if cover is None:
            room = channel.room(fit.max_gaussians, fit.sh_degree)
            return WholeRoom(fit.max_gaussians, fit.sh_degree, channel, room)
        prepared = channel.prepare(cover.with_sh_degree(min(cover.sh_degree, fit.sh_degree)))
        return WholeRoom(len(cover), prepared.cover.sh_degree, channel, prepared, prepared)

    def sizes(self, secrets: Sequence[Wanted]) -> list[tuple[int, int]]:
        if self.room.grows:
            return [each.size for each in secrets]
        return [
            (min(each.count, max(1, each.count * share // each.bytes)), each.sh_degree)
            for each, share in zip(secrets, self._shares(secrets), strict=True)
        ]

    def refit_sizes(
        self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]
    ) -> list[tuple[int, int]]:
        secrets, found = list(map(Wanted.of, models)), []
        for model, share, views in zip(models, self._shares(secrets), viewpoints, strict=True):
            kept = pruned(model, share, views)
            count = len(kept) if len(kept) == len(model) else max(1, int(_FITTING * len(kept)))
            found.append((count, kept.sh_degree))
        return found

    def check(self, secrets: Sequence[Wanted]) -> None:
        with advising(UsageError, f'{_OTHERS}, `publish="ply"` has more room'):
            for each, share in zip(secrets, self._shares(secrets), strict=True):
                if each.model is not None and self.prepared is not None:
                    check_fits(each.model, share)

    def plan(self, secrets: Sequence[Wanted]) -> Plan:
        found = super().plan(secrets)
        if self.room.grows:
            more = sum(self.channel.appended(each.bytes) for each in secrets)
            note = f"about {more:,} Gaussians that nobody sees are appended to the cover's {self.gaussians:,}"
            return replace(found, gaussians=self.gaussians + more, notes=(note,))
        how = "about" if self.prepared is None else "exactly"
        note = f"the {self.channel.place} have room for {how} {self.room.capacity:,} bytes"
        return replace(found, notes=(note,))

    def embed(
        self,
        keys: Sequence[str],
        models: Sequence[Gaussians],
        viewpoints: Sequence[Viewpoints],
        entropy: bytes | None,
    ) -> Embedded:
        if self.prepared is None:
            raise ValueError("the cover is still to be fitted")
        return embed_whole(self.prepared, keys, models, viewpoints, prune=True, entropy=entropy)

    def _shares(self, secrets: Sequence[Wanted]) -> list[int]:
        """Bytes for the encoding of each secret."""
        if self.room.grows:
            return [self.room.capacity // len(secrets) - self.room.overhead] * len(secrets)
        return shares([each.bytes for each in secrets], self.room.capacity, self.room.overhead)


def room_for(
    cover: Gaussians | None, options: CarryOptions, entropy: bytes | None = None
) -> RecordRoom | WholeRoom:
    """The room in a cover, or about that in one that is still to be fitted.

    Raises UsageError and InputError for a cover without room.
    """
    if options.place.records:
        return RecordRoom.of(cover, options, entropy)
    return WholeRoom.of(cover, options)


def _prepared(cover: Gaussians, options: CarryOptions, entropy: bytes | None = None) -> LowBitsCover:
    """The cover with the harmonics and the low bits that `options` ask for, else as it is.

    Raises InputError where the low bits are not random.
    """
    entropy = os.urandom(32) if entropy is None else entropy
    if options.sh_degree is not None:
        cover = of_degree(cover, options.sh_degree, entropy)
    try:
        LOW_BITS.prepare(sampled(cover))
        return LOW_BITS.prepare(cover)
    except InputError:
        if not options.dither:
            raise
    return LOW_BITS.prepare(dither(cover, expand(entropy, "carry/dither", 32)))


def of_degree(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` with harmonics of `sh_degree`; those that it does not have are too small to be seen."""
    if model.sh_degree > sh_degree:
        return model.with_sh_degree(sh_degree)
    return raised(model, sh_degree, expand(entropy, "carry/raised", 32))


def _ways(cover: Gaussians | None, options: CarryOptions) -> str:
    """Options that give a cover room in its low bits, the fewest that do, and what always works."""
    changes: list[dict[str, Any]] = [{"dither": True}, {"sh_degree": 1}, {"sh_degree": 1, "dither": True}]
    for each in changes:
        changed = replace(options, **each)
        degree = changed.fit.sh_degree if changed.sh_degree is None else changed.sh_degree
        if record_degree(degree) is None:
            continue
        try:
            if cover is not None:
                _prepared(cover, changed)
        except InputError:
            continue
        asked = ", ".join(f"{name}={value}" for name, value in each.items())
        return f"`{asked}` makes room{_growth(cover, degree)}, {ANY}"
    return ANY


def _growth(cover: Gaussians | None, sh_degree: int) -> str:
    """How much larger the cover's file gets with harmonics of `sh_degree`."""
    if cover is None or cover.sh_degree >= sh_degree:
        return ""
    before, after = (
        len(cover) * 4 * (14 + 3 * (each + 1) ** 2) / 1e6 for each in (cover.sh_degree, sh_degree)
    )
    return f" (the cover takes {after:.1f} MB then instead of {before:.1f})"
