"""What fits into the low bits of a cover, and models that are made ready for that."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import torch

from keyss.channels.low_bits import LOW_BITS, LowBitsCover
from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.layout import Room, record_capacity
from keyss.channels.low_bits.spread import TYPICAL_SHARE, check_payload_fits
from keyss.core.errors import InputError, KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import expand
from keyss.methods.base import advising
from keyss.methods.dither import dither, raised, sampled
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.options import LearnedOptions, decoder_shape, training_options
from keyss.methods.learned.payload import ANCHORS, HiddenSecret, pack_secret
from keyss.methods.points import divided
from keyss.methods.records.encoding import record_request
from keyss.methods.records.table import Table

LEAST_SECRET = 16  # Gaussians
_SMALLER = (
    "beside the others, secrets are left fewer Gaussians than each could have alone: who holds one of the "
    "keys can notice that there are other secrets"
)
_ANY = '`publish="any"` has room for all'
APPENDED = "the secrets lie in appended Gaussians instead, and everybody can see that they are there"


def prepared_cover(cover: Gaussians, entropy: bytes) -> LowBitsCover:
    """The cover itself where its low bits are random, else with new ones. Raises InputError without room."""
    try:
        return LOW_BITS.prepare(cover)
    except InputError:
        return LOW_BITS.prepare(dither(cover, expand(entropy, "start/1", 32)))


def of_degree(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` with harmonics of `sh_degree`; those that it does not have are too small to be seen."""
    if model.sh_degree > sh_degree:
        return model.with_sh_degree(sh_degree)
    return raised(model, sh_degree, expand(entropy, "start/0", 32))


def record_degree(sh_degree: int) -> int | None:
    """The highest SH degree of secrets whose records fit into a Gaussian of `sh_degree`; None if none does.

    3, 2 and 0 in models of degree 3, 2 and 1.
    """
    room = LOW_BITS.largest_record(sh_degree)
    fitting = (each for each in range(sh_degree, -1, -1) if Table.floor(each).record_bytes <= room)
    return next(fitting, None)


def carriers_of(cover: Gaussians | None, gaussians: int, sh_degree: int) -> int:
    """How many Gaussians of a cover can carry something, of a large one estimated from a sample.

    None: of one of so many `gaussians` that is still to be fitted. Raises InputError without room.
    """
    if cover is None:
        return int(TYPICAL_SHARE * gaussians)
    entropy = os.urandom(32)
    sample = of_degree(sampled(cover), sh_degree, entropy)
    carriers = prepared_cover(sample, entropy).carriers
    return int(carriers / len(sample) * len(cover))


def secret_sizes(wanted: Sequence[int], cover: int, carriers: int, options: LearnedOptions) -> list[int]:
    """How many Gaussians of each secret fit into a `cover` of so many Gaussians, some of them `carriers`.

    `wanted`: sizes of the secrets' plain models.
    """
    sh_degree = options.fit.sh_degree
    degree = record_degree(sh_degree)
    if degree is None:
        return [0] * len(wanted)
    most = [min(each, int(options.secret_share * cover)) for each in wanted]
    # No key should tell whether there are other secrets; where that leaves nothing, what fits at all.
    room = Room(carriers, bytes_per_gaussian(sh_degree))
    if each := room.unnoticed_records(Table.floor(degree).record_bytes, len(most)):
        return [min(count, each) for count in most]
    requests = [record_request(count, degree) for count in most]
    return divided(most, [1.0] * len(most), record_capacity(requests, carriers, sh_degree))


def check_room(options: LearnedOptions, models: Sequence[Gaussians | None]) -> None:
    """Raise UsageError or InputError if secrets will not fit into the low bits of their cover.

    `models`: of the cover and of the secrets, those that are known. Warns (KeyssWarning) where decoders will
    not, and where the holder of one key can notice that there are other secrets.
    """
    options = training_options(options)
    degree, cap, cover = options.fit.sh_degree, options.fit.max_gaussians, models[0]
    if options.start == "points":
        try:
            check_payload_fits(_largest_payload(options), cap, len(models) - 1, degree)
        except UsageError as error:
            warnings.warn(f"{error}; {APPENDED}", KeyssWarning, stacklevel=2)
        return
    if record_degree(degree) is None:
        raise UsageError(
            f"a model of SH degree {degree} has no room for anything in its low bits; `sh_degree=1` makes "
            f"room{_growth(cover)}, {_ANY}"
        )
    gaussians = cap if cover is None else len(cover)
    with advising(InputError, _ANY):
        carriers = carriers_of(cover, gaussians, degree)
    sizes = [cap if each is None else len(each) for each in models[1:]]
    counts = secret_sizes(sizes, gaussians, carriers, options)
    alone = [secret_sizes([each], gaussians, carriers, options)[0] for each in sizes]
    if counts != alone:
        warnings.warn(_SMALLER, KeyssWarning, stacklevel=2)
    if min(counts) < min(LEAST_SECRET, *sizes):
        raise UsageError(
            f"a cover of {gaussians:,} Gaussians is too small to hide {len(sizes)} secret"
            f"{'s' if len(sizes) > 1 else ''} in its low bits; a larger one has room, {_ANY}"
        )


def _growth(cover: Gaussians | None) -> str:
    """What it costs that a model of SH degree 0 gets degree 1."""
    if cover is None:
        return ""
    before, after = (len(cover) * 4 * (14 + 3 * count) / 1e6 for count in (1, 4))
    return f" (the cover takes {after:.1f} MB then instead of {before:.1f})"


def _largest_payload(options: LearnedOptions) -> int:
    """Bytes of a secret whose decoder cannot be compressed."""
    decoder = Decoder(decoder_shape(options))
    return len(pack_secret(HiddenSecret(decoder, Similarity.identity(), torch.rand(ANCHORS, 3))))
