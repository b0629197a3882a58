"""What fits into the low bits of a model that is still to be trained."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import torch

from keyss.channels.low_bits import LOW_BITS
from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.layout import Room, record_capacity
from keyss.channels.low_bits.spread import TYPICAL_SHARE, check_payload_fits
from keyss.channels.low_bits.usable import usable_carriers
from keyss.core.errors import InputError, KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import expand
from keyss.methods.base import advising
from keyss.methods.dither import dither, raised, sampled
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.options import LearnedOptions, decoder_shape, training_options
from keyss.methods.learned.payload import ANCHORS, HiddenSecret, pack_secret
from keyss.methods.records.encoding import record_request
from keyss.methods.records.table import Table

# Of the Gaussians before training, which brings those that it reaches, about half and more, to 0.72.
LEAST_USABLE_AT_START = 0.28
LEAST_SECRET = 16  # Gaussians
_SMALLER = (
    "beside the others, secrets are left fewer Gaussians than each could have alone: who holds one of the "
    "keys can notice that there are other secrets"
)
_SIDECAR = "`sidecar=True` writes a file beside it instead"


def with_low_bits(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` as the joint training starts from it, with low bits that are random before the first step."""
    first, second = (expand(entropy, f"start/{index}", 32) for index in range(2))
    return dither(raised(model.with_sh_degree(min(sh_degree, model.sh_degree)), sh_degree, first), second)


def record_degree(sh_degree: int) -> int | None:
    """The highest SH degree of secrets whose records fit into a Gaussian of `sh_degree`; None if none does.

    3, 2 and 0 in models of degree 3, 2 and 1.
    """
    room = LOW_BITS.largest_record(sh_degree)
    fitting = (each for each in range(sh_degree, -1, -1) if Table.floor(each).record_bytes <= room)
    return next(fitting, None)


def usable_share(cover: Gaussians | None, sh_degree: int) -> float:
    """Of the Gaussians of a cover before training, from a sample: 0 to 1; None: typical of what is fitted."""
    if cover is None:
        return TYPICAL_SHARE
    start = with_low_bits(sampled(cover), sh_degree, os.urandom(32))
    return float(usable_carriers(start).mean())


def shares(sizes: Sequence[int], options: LearnedOptions, usable: float) -> list[int]:
    """How many Gaussians of each plain model, of which there are `sizes`, training starts with.

    In records the secrets' take no place of the cover's, of which a share `usable` carries something;
    otherwise all share the cap.
    """
    cap = options.fit.max_gaussians
    if options.in_records:
        cover = min(sizes[0], cap)
        return [cover, *_secret_sizes(sizes[1:], cover, options, usable)]
    return divided(sizes, [1.0] + [options.secret_share] * (len(sizes) - 1), cap)


def _secret_sizes(wanted: Sequence[int], cover: int, options: LearnedOptions, usable: float) -> list[int]:
    """How many Gaussians of each secret fit into a published model of `cover` Gaussians."""
    most = [min(each, int(options.secret_share * cover)) for each in wanted]
    degree = record_degree(options.fit.sh_degree)
    if degree is None:
        return [0] * len(most)
    carriers, sh_degree = int(usable * cover), options.fit.sh_degree
    # No key should tell whether there are other secrets; where that leaves nothing, what fits at all.
    room = Room(carriers, bytes_per_gaussian(sh_degree))
    if each := room.unnoticed_records(Table.floor(degree).record_bytes, len(most)):
        return [min(count, each) for count in most]
    requests = [record_request(count, degree) for count in most]
    return divided(most, [1.0] * len(most), record_capacity(requests, carriers, sh_degree))


def divided(available: Sequence[int], weights: Sequence[float], total: int) -> list[int]:
    """`total` items divided by `weights`, nowhere more than `available`; what is left over is given on."""
    shares = [0] * len(available)
    while (left := total - sum(shares)) > 0:
        open_ends = [i for i in range(len(available)) if shares[i] < available[i]]
        if not open_ends:
            break
        weight = sum(weights[i] for i in open_ends)
        for i in open_ends:
            fair = max(1, int(left * weights[i] / weight))
            shares[i] += min(fair, available[i] - shares[i], total - sum(shares))
    return shares


def check_room(options: LearnedOptions, models: Sequence[Gaussians | None]) -> None:
    """Raise UsageError or InputError if what is to be hidden will not fit into the model that is trained.

    `models`: of the cover and of the secrets, those that are known. Training leaves the low bits of some
    Gaussians of a given model as they are.
    """
    options = training_options(options)
    degree, cap, cover = options.fit.sh_degree, options.fit.max_gaussians, models[0]
    if not options.in_records:
        payload, advice = _largest_payload(options), f"a larger `max_gaussians` makes room, {_SIDECAR}"
        with advising(UsageError, advice if degree else f"`sh_degree=1` makes room, {_SIDECAR}"):
            check_payload_fits(payload, cap, len(models) - 1, degree)
        return
    if record_degree(degree) is None:
        raise UsageError(
            f"a model of SH degree {degree} has no room for anything in its low bits; `sh_degree=1` makes "
            f"room{_growth(cover)}, {_SIDECAR}"
        )
    usable = usable_share(cover, degree)
    if usable < LEAST_USABLE_AT_START:
        raise InputError(
            f"only {usable:.0%} of the cover's Gaussians could have random low bits, the others hold equal "
            f"values; {_SIDECAR}"
        )
    if cover is not None:
        cap = min(cap, len(cover))
    sizes = [cap if each is None else len(each) for each in models[1:]]
    counts = _secret_sizes(sizes, cap, options, usable)
    alone = [_secret_sizes([each], cap, options, usable)[0] for each in sizes]
    if counts != alone:
        warnings.warn(_SMALLER, KeyssWarning, stacklevel=2)
    if min(counts) < min(LEAST_SECRET, *sizes):
        raise UsageError(
            f"a cover of {cap:,} Gaussians is too small to hide {len(sizes)} secret"
            f"{'s' if len(sizes) > 1 else ''} in its low bits; a larger one has room, {_SIDECAR}"
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
