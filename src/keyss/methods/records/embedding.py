"""Models into the low bits of a prepared cover, and opened again as their readers will."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from keyss.channels.base import Content, Records
from keyss.channels.low_bits import LOW_BITS, LowBitsCover
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.methods.dither import cost
from keyss.methods.records.encoding import CarriedSecret, decode, encode_all, most_visible, record_requests
from keyss.methods.records.quantise import out_of_range


@dataclass(frozen=True)
class Embedded:
    """What embedding gives."""

    prepared: LowBitsCover
    models: Sequence[Gaussians]  # whole
    kept: Sequence[Gaussians]  # what of them was embedded
    stego: Gaussians
    opened: tuple[CarriedSecret, ...]

    def details(self, cover: Gaussians) -> dict[str, Any]:
        """Numbers for metrics.json, some of which take renders; `cover`: before it was prepared."""
        details: dict[str, Any] = {
            "carriers": self.prepared.carriers,
            "capacity": self.prepared.record_capacity(record_requests(self.models)),
            "gaussians_before_pruning": [len(model) for model in self.models],
            "bits_per_gaussian": [each.bits for each in self.opened],
        }
        if any(clamped := [out_of_range(model) for model in self.kept]):
            details["gaussians_with_clamped_numbers"] = clamped
        pairs = list(zip(self.models, self.kept, strict=True))
        if any(part is not model for model, part in pairs):
            details["share_kept_by_pruning"] = [round(len(part) / len(model), 4) for model, part in pairs]
            details["pruned_secret_psnr_against_the_whole"] = [
                None if part is model else round(cost(model, part), 1) for model, part in pairs
            ]
        if self.prepared.cover is not cover:
            details["dithered_cover_psnr_against_the_one_before"] = round(cost(cover, self.prepared.cover), 1)
        return details


def embed_models(
    prepared: LowBitsCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    counts: Sequence[int],
    method: str,
    *,
    entropy: bytes | None = None,
) -> Embedded:
    """Of each model its `counts` most visible Gaussians, under its key, opened again.

    `method`: the name of the one that will open them. Raises UsageError if they do not fit.
    """
    kept = [most_visible(model, count) for model, count in zip(models, counts, strict=True)]
    records = encode_all(prepared, kept, method)
    stego = prepared.embed(list(zip(keys, records, strict=True)), entropy=entropy)
    opened = tuple(unpack_records(LOW_BITS.extract(stego, key)) for key in keys)
    if [len(each.gaussians) for each in opened] != [len(model) for model in kept]:
        raise RuntimeError("what was written does not open again as it should")
    return Embedded(prepared, models, kept, stego, opened)


def unpack_records(content: Content) -> CarriedSecret:
    """The Gaussians that are left. Raises InputError for damage."""
    if not isinstance(content, Records):
        raise InputError("the hidden secret is damaged: expected records, got one payload")
    return decode(content)
