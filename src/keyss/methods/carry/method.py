"""The carry method: the secret's Gaussians, quantised and encrypted, in the low bits of the cover's."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

from keyss.channels.base import Content, PreparedCover, Records
from keyss.channels.low_bits import LOW_BITS
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Context, KeyedSource, SceneInput, Source, Stego, advising
from keyss.methods.carry.carrying import (
    NAME,
    CarriedSecret,
    check_degrees,
    decode,
    encode_all,
    most_visible,
    record_requests,
    subsampled_counts,
)
from keyss.methods.carry.dither import cost, dither
from keyss.methods.carry.options import PRESETS, CarryOptions
from keyss.methods.carry.quantise import out_of_range

_PRUNE = "`prune_to_fit=True` leaves out the least visible"
_SIDECAR = '`method="learned", sidecar=True` needs no room in the cover\'s low bits'
_DITHER = f"`dither=True` gives it new low bits, at a price, and {_SIDECAR}"


class CarryMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "carry models in the low bits of the cover's"
    trains = False
    most_secrets = 256
    options = CarryOptions
    presets: Mapping[str, CarryOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: CarryOptions) -> CarryOptions:
        """Unchanged; refuses given models that do not fit, and a cover whose low bits are not random."""
        cover, *others = (each.model for each in inputs)
        secrets = [model for model in others if model is not None]
        if cover is not None and secrets:
            check_degrees(LOW_BITS, cover, secrets)
        if cover is not None:
            prepared = _prepared(_carrier(cover, options), options)
            if len(secrets) == len(others):
                _counts(prepared, secrets, options)
        return options

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: CarryOptions, context: Context
    ) -> Stego:
        """Carry the secrets, and open each again as its reader will.

        Raises UsageError for too large secrets, InputError for a cover whose low bits are not random.
        """
        start = time.monotonic()
        models, keys = [each.source.model for each in secrets], [each.key for each in secrets]
        check_degrees(LOW_BITS, cover.model, models)
        carrier = _carrier(cover.model, options)
        prepared = _prepared(carrier, options)
        details: dict[str, Any] = {
            "carriers": prepared.carriers,
            "capacity": prepared.record_capacity(record_requests(models)),
            "gaussians_before_pruning": [len(model) for model in models],
        }
        whole, counts = models, _counts(prepared, models, options)
        models = [most_visible(model, count) for model, count in zip(whole, counts, strict=True)]
        records = encode_all(prepared, models)
        stego = prepared.embed(list(zip(keys, records, strict=True)))
        opened = [self.unpack(LOW_BITS.extract(stego, key)) for key in keys]
        seconds = time.monotonic() - start
        if [len(each.gaussians) for each in opened] != [len(model) for model in models]:
            raise RuntimeError("what was written does not open again as it should")
        details["bits_per_gaussian"] = [each.bits for each in opened]
        if any(clamped := [out_of_range(model) for model in models]):
            details["gaussians_with_clamped_numbers"] = clamped
        if options.prune_to_fit:
            pairs = list(zip(whole, models, strict=True))
            details["share_kept_by_pruning"] = [round(len(kept) / len(model), 4) for model, kept in pairs]
            details["pruned_secret_psnr_against_the_whole"] = [
                None if kept is model else round(cost(model, kept), 1) for model, kept in pairs
            ]
        if options.dither:
            details["dithered_cover_psnr_against_the_one_before"] = round(cost(cover.model, carrier), 1)
        return Stego(stego, None, tuple(opened), seconds, details=details)

    def unpack(self, content: Content) -> CarriedSecret:
        """The Gaussians that are left. Raises InputError for damage."""
        if not isinstance(content, Records):
            raise InputError("the hidden secret is damaged: expected records, got one payload")
        return decode(content)

    def attacks(self, stego: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
        """None: without a key, low bits that carry something are as random as any."""
        return {}


def _carrier(cover: Gaussians, options: CarryOptions) -> Gaussians:
    """The cover, with new low bits if that is wanted."""
    return dither(cover, os.urandom(32)) if options.dither else cover


def _prepared(carrier: Gaussians, options: CarryOptions) -> PreparedCover:
    """Raises InputError for low bits that are not random."""
    with advising(InputError, _SIDECAR if options.dither else _DITHER):
        return LOW_BITS.prepare(carrier)


def _counts(prepared: PreparedCover, models: Sequence[Gaussians], options: CarryOptions) -> list[int]:
    """How many Gaussians of each model are carried: all, unless pruning may leave some out.

    Raises UsageError if they do not fit.
    """
    with advising(UsageError, _SIDECAR):
        kept = subsampled_counts(prepared, models)  # refuses where pruning would not help either
    if options.prune_to_fit:
        return kept
    with advising(UsageError, _PRUNE):
        prepared.plan_records(record_requests(models))
    return [len(model) for model in models]
