"""How precisely a model is encoded whole, for the room there is and for what will be seen."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.records.encoding import most_visible
from keyss.methods.records.table import Table
from keyss.methods.records.whole import MAX_BITS, USUAL_BITS, Precision, decode, encode
from keyss.rendering.difference import Viewpoints, psnr_between

_GOOD_ENOUGH = 44.0  # dB of pictures against those of the model: of photos at 30 dB it takes 0.2
# Of each attribute alone, until they are good enough together; shares of opacities, of which there are fewer
# than of others, and of harmonics, of which more numbers than three become longer.
_GOALS, _BIT = range(47, 61), 6.02  # dB
_ATTRIBUTES, _SHARES = ("means", "log_scales", "quats", "opacity_logits"), (0, 0, 0, 4.8, 0, -8)
_FEWEST, _MAX = (8, 4, 4, 4, 4), 20  # bits
_COARSEST = 0.1  # step of harmonics: they show from near, and not from around


def good_enough(model: Gaussians, viewpoints: Viewpoints | None = None) -> Precision:
    """The coarsest precision of which the pictures are good enough, as far as few tries tell.

    What an attribute costs alone is measured once, and 6 dB are a bit. The fewest bits in all are those with
    which the squared error of each is in proportion to the numbers that a bit more is spent on.
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


def least_bytes(model: Gaussians) -> int:
    """Of the encoding below which a secret is rather pruned."""
    return len(encode(model))


def check_fits(model: Gaussians, room: int) -> None:
    """Raises UsageError where `model` takes more than `room` bytes."""
    least = least_bytes(model)
    if least > room:
        raise UsageError(
            f"the secret of {len(model):,} Gaussians takes {least:,} bytes, and there is room for "
            f"{room:,}: about {max(0, len(model) * room // least):,} of its Gaussians"
        )


def pruned(model: Gaussians, room: int, viewpoints: Viewpoints | None = None) -> Gaussians:
    """All of `model` if it fits into `room` bytes, else its most visible Gaussians.

    These are of the SH degree that renders most like the model. Raises UsageError where nothing fits.
    """
    if least_bytes(model) <= room:
        return model
    degrees = range(model.sh_degree + 1)
    candidates = [found for each in degrees if (found := _pruned(model.with_sh_degree(each), room))]
    if not candidates:
        raise UsageError(f"nothing of a secret fits into {room:,} bytes")
    return max(candidates, key=lambda each: psnr_between(model, each, viewpoints))


def fitted(
    model: Gaussians, room: int, *, prune: bool, short: bool = False, viewpoints: Viewpoints | None = None
) -> tuple[Gaussians, bytes]:
    """What of `model` is encoded, and it in at most `room` bytes, as precise as it fits.

    `short`: no more precise than is hard to see from the `viewpoints`. Raises UsageError for what does not
    fit without `prune`, and where nothing fits.
    """
    if short and len(data := encode(model, good_enough(model, viewpoints))) <= room:
        return model, data
    if prune:
        model = pruned(model, room, viewpoints)
    else:
        check_fits(model, room)
    return model, _most_precise(model, room)


def _pruned(model: Gaussians, room: int) -> Gaussians | None:
    """The most visible Gaussians that fit into `room` bytes; None if not even one does."""
    count = len(model)
    while count > 0:
        kept = most_visible(model, count)
        size = least_bytes(kept)
        if size <= room:
            return kept
        count = min(count - 1, int(0.995 * count * room / size))
    return None


def _most_precise(model: Gaussians, room: int) -> bytes:
    """The longest encoding that fits, at least that of the usual bits."""
    usual = encode(model)
    more = 8 * (room - len(usual)) // len(model)
    for bits in range(min(MAX_BITS, USUAL_BITS + more), USUAL_BITS, -2):
        data = encode(model, Precision.of_size(bits))
        if len(data) <= room:
            return data
    return usual
