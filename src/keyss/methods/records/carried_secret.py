"""Open carried secrets from records or a payload."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

from keyss.channels.base import Content, Records
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians, compensate_pruning
from keyss.methods.hidden import Frame, HiddenScene, Remains
from keyss.methods.records import whole
from keyss.methods.records.quantise import Codec

COUNT = struct.Struct("<I")  # number of Gaussians, before the codec in the header of records


@dataclass(frozen=True)
class CarriedSecret(HiddenScene):
    """A carried secret."""

    left: int  # Gaussians that are left
    count: int  # Gaussians that were embedded
    bits: int  # per record, or per Gaussian of a payload
    load: Callable[[], Gaussians]
    frame = None

    @cached_property
    def gaussians(self) -> Gaussians:
        """The Gaussians that are left, in the order of their carriers; decoded on first use."""
        return self.load()

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The Gaussians that are left, with pruning compensation for those lost with their carriers."""
        if frame == "cover":
            raise UsageError(
                'a carried secret has no position in the cover\'s coordinates: leave out `frame="cover"`'
            )
        return compensate_pruning(self.gaussians, self.count)

    def remains(self, revealed: Gaussians) -> Remains:
        return Remains(len(revealed), self.count)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.gaussians.means.numpy().tobytes()).hexdigest()[:16]


def unpack(content: Content) -> CarriedSecret:
    """Open records, in any order, or a payload. Raises InputError for damage."""
    if not isinstance(content, Records):
        gaussians = whole.decode(content.data, content.model_size)
        count = len(gaussians)
        return CarriedSecret(count, count, round(8 * len(content.data) / count), lambda: gaussians)
    if len(content.header) < COUNT.size:
        raise InputError("the hidden parameters are damaged: they are too short")
    (count,) = COUNT.unpack_from(content.header)
    codec = Codec.unpack(content.header[COUNT.size :])
    expected, found = codec.table.record_bytes, content.records.shape[1]
    if found != expected:
        raise InputError(f"the hidden parameters are damaged: records of {found} bytes, expected {expected}")
    load = partial(codec.decode, content.records)
    return CarriedSecret(len(content.records), count, codec.table.total, load)
