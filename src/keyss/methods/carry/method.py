"""The carry method: the secret's Gaussians, quantised and encrypted, in the low bits of the cover's."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from keyss.channels.base import Content, Records
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import filled
from keyss.methods.base import Capabilities, Context, Frame, KeyedSource, Opened, SceneInput, Source, Stego
from keyss.methods.carry.carrying import (
    Carried,
    Carriers,
    derive_all,
    embed_derived,
    extract_derived,
    usable_carriers,
)
from keyss.methods.carry.dither import cost, dither
from keyss.methods.carry.options import PRESETS, CarryOptions
from keyss.methods.carry.plan import PREFIX_BYTES, Size, check_degrees, plan, room, thinned
from keyss.methods.carry.quantise import Codec
from keyss.methods.carry.thinning import most_visible

NAME = "carry"


@dataclass(frozen=True)
class OpenedCarried:
    """A carried secret as its key opens it; see `keyss.methods.base.Opened`."""

    carried: Carried
    frame: None = None
    decode: None = None

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """Gaussians that were lost with their carriers, the others make up for."""
        if frame == "cover":
            raise UsageError("a carried secret never lay in the cover's coordinates: leave out --frame cover")
        return filled(self.carried.gaussians, self.carried.count)

    def fingerprint(self) -> str:
        return self.carried.fingerprint()


class CarryMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "carry models in the low bits of the cover's"
    capabilities = Capabilities(
        trains=False,
        decoder=False,
        standard_file=True,
        most_secrets=256,
        sidecar=False,
        recommended_for="files that are passed on unchanged",
    )
    options = CarryOptions
    presets: Mapping[str, CarryOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: CarryOptions) -> CarryOptions:
        """Unchanged; refuses models that do not fit and covers whose low bits are not random."""
        cover, *secrets = (each.model for each in inputs)
        degree = options.fit.sh_degree  # of models that are to be fitted
        sizes = [Size(0, degree) if each is None else _size(each) for each in secrets]
        check_degrees(sizes, degree if cover is None else cover.sh_degree)
        if cover is not None and not options.dither:
            count = int(usable_carriers(cover).sum())
            if not options.prune_to_fit:  # secrets that are to be fitted count as empty
                plan(sizes, count, len(cover), cover.sh_degree)
        return options

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: CarryOptions, context: Context
    ) -> Stego:
        """Carry the secrets, and open each again as its reader will.

        Raises UsageError for secrets that are too large, InputError for a cover whose low bits are not random.
        """
        start = time.monotonic()
        models = [each.source.model for each in secrets]
        sizes = [_size(model) for model in models]
        check_degrees(sizes, cover.model.sh_degree)
        carrier = dither(cover.model, os.urandom(32)) if options.dither else cover.model
        usable = usable_carriers(carrier)
        count = int(usable.sum())
        if options.prune_to_fit:
            kept = thinned(sizes, count, carrier.sh_degree)
            models = [most_visible(model, most) for model, most in zip(models, kept, strict=True)]
        keys = derive_all(carrier, [each.key for each in secrets])
        stego = embed_derived(carrier, list(zip(keys, models, strict=True)), usable=usable)
        written = Carriers.of(stego)
        opened = [extract_derived(written, own[0]) for own in keys]
        seconds = time.monotonic() - start
        if [len(carried.gaussians) for carried in opened] != [len(model) for model in models]:
            raise RuntimeError("what was written does not open again as it should")
        details = {
            "carriers": count,
            "room": room(sizes, count, carrier.sh_degree),
            "gaussians_of_secrets": [size.count for size in sizes],
            "bits_of_a_gaussian": [carried.bits for carried in opened],
        }
        if options.dither:
            details["dither_psnr"] = round(cost(cover.model, carrier), 1)
        return Stego(stego, None, tuple(OpenedCarried(each) for each in opened), seconds, details=details)

    def unpack(self, content: Content) -> Opened:
        """The Gaussians that are left. Raises InputError for damage."""
        if not isinstance(content, Records):
            raise InputError("what the key opens is damaged: expected records, got one payload")
        codec = Codec.unpack(content.header[PREFIX_BYTES:])
        count = int.from_bytes(content.header[2:PREFIX_BYTES], "little")
        return OpenedCarried(Carried(codec.decode(content.records), count, codec.table.total))

    def attacks(self, stego: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
        """None: without a key, low bits that carry something are as random as any."""
        return {}


def _size(model: Gaussians) -> Size:
    return Size(len(model), model.sh_degree)
