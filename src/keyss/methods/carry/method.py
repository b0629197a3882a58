"""The carry method: the secret's Gaussians, quantised and encrypted, in the low bits of the cover's."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from keyss.channels.base import Content, RecordRequest
from keyss.channels.low_bits import LOW_BITS, LowBitsCover
from keyss.channels.low_bits.layout import plan_records, record_capacity
from keyss.channels.rooms import room_in
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import expand
from keyss.methods.base import (
    Capabilities,
    Context,
    KeyedSource,
    Outlook,
    SceneInput,
    Source,
    Stego,
    advising,
)
from keyss.methods.carry.options import PRESETS, CarryOptions
from keyss.methods.dither import dither, sampled
from keyss.methods.records.embedding import embed_models, embed_whole, shares_of, unpack_records
from keyss.methods.records.encoding import (
    CarriedSecret,
    check_degrees,
    record_request,
    record_requests,
    subsampled_counts,
)
from keyss.methods.records.precision import check_fits
from keyss.methods.records.prospect import outlook_whole
from keyss.rendering.difference import Viewpoints, cost

_PRUNE = '`prune_to_fit=True` leaves out the least visible, `publish="any"` has room'
_ANY = '`publish="any"` needs no low bits of the cover'
_DITHER = f"`dither=True` gives it new low bits, {_ANY}"
_DITHER_AND_PRUNE = (
    f"`dither=True, prune_to_fit=True` gives it new low bits and leaves out the least visible, {_ANY}"
)
_PRUNE_OR_PLY = '`prune_to_fit=True` leaves out what is seen least, `publish="ply"` has more room'

NAME = "carry"


class CarryMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "carry models in the low bits of the cover's"
    trains = False
    most_secrets = 256
    capabilities = Capabilities()
    options = CarryOptions
    presets: Mapping[str, CarryOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: CarryOptions) -> CarryOptions:
        """Refuses given models that will not fit, and a given cover whose low bits are not random.

        Of models that are fitted first, sizes and low bits are not known: they are made to fit rather than
        refused after their training.
        """
        if options.publish != "ply":
            return _prepared_for_room(inputs, options)
        cover, *others = (each.model for each in inputs)
        degree, *degrees = _degrees(inputs, options)
        check_degrees(LOW_BITS, degree, degrees)
        secrets = [model for model in others if model is not None]
        requests = record_requests(secrets)
        if cover is None:
            if requests and not options.prune_to_fit:
                with advising(UsageError, _PRUNE):  # at best all of them can carry something
                    plan_records(requests, options.fit.max_gaussians, degree)
            return replace(options, dither=True, prune_to_fit=True)
        try:
            prepared = _prepared(cover, options)
        except InputError as error:
            raise InputError(
                f"{error}; {_ways(cover, options, [] if options.prune_to_fit else requests)}"
            ) from error
        if len(secrets) < len(others):
            return replace(options, prune_to_fit=True)
        _counts(prepared, secrets, options)
        return options

    def outlook(self, inputs: Sequence[SceneInput], options: CarryOptions) -> Outlook:
        """The cover as it is, and in it what its carriers have room for."""
        if options.publish != "ply":
            return outlook_whole(inputs, options)
        sizes = [options.fit.max_gaussians if each.model is None else len(each.model) for each in inputs]
        degrees = _degrees(inputs, options)
        cover, notes = inputs[0].model, []
        carriers = sizes[0]
        if cover is not None:
            prepared = _prepared(cover, options)
            carriers = prepared.carriers
            if prepared.cover is not cover:
                psnr = cost(cover, prepared.cover)
                notes.append(f"dithering leaves the cover at {psnr:.1f} dB PSNR against itself")
        requests = list(map(record_request, sizes[1:], degrees[1:]))
        asked = sum(sizes[1:])
        fit = record_capacity(requests, carriers, degrees[0])
        return Outlook(sizes[0], degrees[0], asked, min(asked, fit), notes=tuple(notes))

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: CarryOptions, context: Context
    ) -> Stego:
        """Carry the secrets, and open each again as its reader will.

        Raises UsageError for too large secrets, InputError for a cover whose low bits are not random.
        """
        start = time.monotonic()
        models, keys = [each.source.model for each in secrets], [each.key for each in secrets]
        if options.publish != "ply":
            room = room_in(cover.model, options.publish, options.channel, repair=options.repair)
            with advising(UsageError, _PRUNE_OR_PLY):
                views = [Viewpoints.of(each.source.scene) for each in secrets]
                written = embed_whole(
                    room, keys, models, views, prune=options.prune_to_fit, entropy=context.entropy
                )
            seconds = time.monotonic() - start
            return Stego(written.stego, written.opened, seconds, details=written.details, verified=True)
        check_degrees(LOW_BITS, cover.model.sh_degree, [model.sh_degree for model in models])
        with advising(InputError, _ANY if options.dither else _DITHER):
            prepared = _prepared(cover.model, options, context.entropy)
        counts = _counts(prepared, models, options)
        found = embed_models(prepared, keys, models, counts, NAME, entropy=context.entropy)
        seconds = time.monotonic() - start
        return Stego(found.stego, found.opened, seconds, details=found.details(cover.model), verified=True)

    def unpack(self, content: Content) -> CarriedSecret:
        """The Gaussians that are left. Raises InputError for damage."""
        return unpack_records(content)


def _prepared_for_room(inputs: Sequence[SceneInput], options: CarryOptions) -> CarryOptions:
    """Refuses given models that will not fit; those that are fitted first are made to fit."""
    cover, *others = (each.model for each in inputs)
    secrets = [model for model in others if model is not None]
    if cover is None or len(secrets) < len(others):
        return replace(options, prune_to_fit=True)
    room = room_in(cover, options.publish, options.channel, repair=options.repair)
    with advising(UsageError, _PRUNE_OR_PLY):
        if not options.prune_to_fit:
            for model, share in zip(secrets, shares_of(room, secrets), strict=True):
                check_fits(model, share)
    return options


def _degrees(inputs: Sequence[SceneInput], options: CarryOptions) -> list[int]:
    """SH degrees of the models that are given, and of those that will be fitted."""
    return [options.fit.sh_degree if each.model is None else each.model.sh_degree for each in inputs]


def _prepared(cover: Gaussians, options: CarryOptions, entropy: bytes | None = None) -> LowBitsCover:
    """The cover as it is, if that will do."""
    try:
        LOW_BITS.prepare(sampled(cover))
        return LOW_BITS.prepare(cover)
    except InputError:
        if not options.dither:
            raise
    random = os.urandom(32) if entropy is None else expand(entropy, "carry/dither", 32)
    return LOW_BITS.prepare(dither(cover, random))


def _ways(cover: Gaussians, options: CarryOptions, requests: Sequence[RecordRequest]) -> str:
    """What works for a cover whose low bits are not random."""
    if options.dither:
        return _ANY
    try:
        prepared = LOW_BITS.prepare(dither(cover, os.urandom(32)))  # all: a sample shows few duplicates
    except InputError:
        return _ANY
    fits = not requests or sum(each.count for each in requests) <= prepared.record_capacity(requests)
    return _DITHER if fits else _DITHER_AND_PRUNE


def _counts(prepared: LowBitsCover, models: Sequence[Gaussians], options: CarryOptions) -> list[int]:
    """How many Gaussians of each model are carried: all, unless pruning may leave some out.

    Raises UsageError if they do not fit.
    """
    with advising(UsageError, _ANY):
        kept = subsampled_counts(prepared, models)  # refuses where pruning would not help either
    if options.prune_to_fit:
        return kept
    with advising(UsageError, _PRUNE):
        prepared.plan_records(record_requests(models))
    return [len(model) for model in models]
