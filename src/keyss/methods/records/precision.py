"""Which Gaussians of a secret are encoded, and how precisely, so that they fit into the room there is."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from keyss.core.arrays import Integers
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.records.lines import Table
from keyss.methods.records.whole import MAX_BITS, USUAL_BITS, Precision, decode, encode
from keyss.rendering.difference import Viewpoints, psnr_between

_GOOD_ENOUGH = 44.0  # dB of renders against those of the model: photos at 30 dB lose 0.2
# PSNR of each attribute alone, until they are good enough together, and what is added to it: more for
# opacities, which are one number of a Gaussian instead of three, and less for harmonics, which are many.
_GOALS, _BIT = range(47, 61), 6.02  # dB
_ATTRIBUTES, _SHARES = ("means", "log_scales", "quats", "opacity_logits"), (0, 0, 0, 4.8, 0, -8)
_FEWEST, _MAX = (8, 4, 4, 4, 4), 20  # bits
_COARSEST = 0.1  # step of harmonics: from afar, where renders are compared, their errors do not show


def good_enough(model: Gaussians, viewpoints: Viewpoints | None = None) -> Precision:
    """The coarsest precision whose renders are good enough, estimated with few renders.

    The cost of each attribute alone is measured once, and one bit is 6 dB. The total is least when the
    squared error of each attribute is in proportion to its count of numbers.
    """
    table, step = Precision.of_size(Table.short().total)
    rough = decode(encode(model, Precision(table, step)))
    model = in_morton_order(model)
    constant = replace(model, sh=torch.cat([rough.sh[:, :1], model.sh[:, 1:]], 1))
    harmonics = replace(model, sh=torch.cat([model.sh[:, :1], rough.sh[:, 1:]], 1))
    changed = [replace(model, **{name: getattr(rough, name)}) for name in _ATTRIBUTES]
    psnrs = [psnr_between(model, each, viewpoints) for each in (*changed, constant, harmonics)]
    for goal in _GOALS:
        missing = [goal + more - each for more, each in zip(_SHARES, psnrs, strict=True)]
        bits = (each + math.ceil(dB / _BIT) for each, dB in zip(table.bits, missing, strict=False))
        found = Table(tuple(min(max(each, least), _MAX) for each, least in zip(bits, _FEWEST, strict=True)))
        precision = Precision(found, min(_COARSEST, step * 10 ** (-missing[-1] / 20)))
        if psnr_between(model, decode(encode(model, precision)), viewpoints) >= _GOOD_ENOUGH:
            break
    return precision


def pruned(model: Gaussians, room: int, viewpoints: Viewpoints | None = None) -> Gaussians:
    """All of `model` if it fits into `room` bytes, else its most visible Gaussians.

    These are of the SH degree that renders most like the model. Raises UsageError if nothing fits.
    """
    if len(encode(model)) <= room:
        return model
    degrees = range(model.sh_degree + 1)
    candidates = [found for each in degrees if (found := _pruned(model.with_sh_degree(each), room))]
    if not candidates:
        raise UsageError(f"nothing of a secret fits into {room:,} bytes")
    return max(candidates, key=lambda each: psnr_between(model, each, viewpoints))


def fitted(
    model: Gaussians, room: int, *, short: bool = False, viewpoints: Viewpoints | None = None
) -> bytes:
    """`model` in at most `room` bytes, as precise as fits.

    `short`: no more precise than is hard to see from the `viewpoints`. Raises UsageError if it does not fit.
    """
    if short and len(data := encode(model, good_enough(model, viewpoints))) <= room:
        return data
    usual = encode(model)
    if len(usual) > room:
        raise UsageError(
            f"a secret of {len(model):,} Gaussians takes {len(usual):,} bytes, and there is room for {room:,}"
        )
    more = 8 * (room - len(usual)) // len(model)
    for bits in range(min(MAX_BITS, USUAL_BITS + more), USUAL_BITS, -2):
        data = encode(model, Precision.of_size(bits))
        if len(data) <= room:
            return data
    return usual


def most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians of `most_visible_rows`; all of them if there are no more."""
    if count >= len(gaussians):
        return gaussians
    return gaussians[torch.from_numpy(most_visible_rows(gaussians, count))]


def most_visible_rows(gaussians: Gaussians, count: int) -> Integers:
    """[count] indices of the Gaussians with the largest opacity times size, in ascending order.

    Size is the square root of the cross-section, and no more than that of a typical large Gaussian:
    otherwise a few huge faint ones would replace all detail.
    """
    size = gaussians.log_scales.sort(dim=1).values[:, 1:].mean(1)  # log, of the larger two axes
    at_most = size.kthvalue(int(0.9 * len(size)) + 1).values
    visibility = gaussians.opacities * size.clamp_max(at_most).exp()
    rows: Integers = visibility.topk(count).indices.sort().values.numpy()
    return rows


def _pruned(model: Gaussians, room: int) -> Gaussians | None:
    """The most visible Gaussians that fit into `room` bytes; None if none fits."""
    count = len(model)
    while count > 0:
        kept = most_visible(model, count)
        size = len(encode(kept))
        if size <= room:
            return kept
        count = min(count - 1, int(0.995 * count * room / size))
    return None
