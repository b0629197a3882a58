"""Choose Gaussians of a secret, and their precision, for a given size."""

from __future__ import annotations

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import torch

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import in_morton_order
from keyss.methods.codec.model_bytes import Precision, decode, encode, encoded_size
from keyss.rendering.orbit import Viewpoints, psnr_between

_GOOD_ENOUGH = 43.75  # dB between renders; costs 0.1 to 0.3 dB at 30 dB against photos
_ATTRIBUTES = ("means", "log_scales", "opacity_logits", "colours", "quats", "harmonics")
# Shares of the squared error, proportional to counts of nonzero numbers: at the optimum, a bit gains as much
# in every attribute.
_SHARES = (3, 3, 1, 3, 3, 18)
_TRIES, _CLOSE, _BIT = 6, 0.15, 6.02  # dB
_COARSEST = 0.1  # maximum step of harmonics, whose errors are invisible from afar
_FINER = 1.5  # octaves below the usual steps: about 52 to 58 dB, 0.01 dB against photos
_SIZES: WeakKeyDictionary[Gaussians, int] = WeakKeyDictionary()  # bytes with the usual precision


def choose_precision(model: Gaussians, viewpoints: Viewpoints | None = None) -> Precision:
    """The coarsest precision with good enough renders.

    Measures the cost of each attribute once, then scales all steps together, to save renders.
    """
    rough = Precision.usual(model).finer(-1)
    model = in_morton_order(model)
    other = decode(encode(model, rough))
    constant = replace(model, sh=torch.cat([other.sh[:, :1], model.sh[:, 1:]], 1))
    harmonics = replace(model, sh=torch.cat([model.sh[:, :1], other.sh[:, 1:]], 1))
    changed = {"colours": constant, "harmonics": harmonics}
    steps = []
    for name, step, share in zip(_ATTRIBUTES, rough.steps, _SHARES, strict=True):
        one = changed.get(name) or replace(model, **{name: getattr(other, name)})
        goal = _GOOD_ENOUGH - 10 * math.log10(share / sum(_SHARES))
        coarsest = _COARSEST if name == "harmonics" else 2 * step
        steps.append(min(step * 10 ** ((psnr_between(model, one, viewpoints) - goal) / 20), coarsest))
    precision = Precision(*steps)
    for _ in range(_TRIES):
        more = psnr_between(model, decode(encode(model, precision)), viewpoints) - _GOOD_ENOUGH
        if 0 <= more < _CLOSE:
            break
        precision = precision.finer((_CLOSE / 2 - more) / _BIT)
    return precision


def prune_to_size(model: Gaussians, max_bytes: int, viewpoints: Viewpoints | None = None) -> Gaussians:
    """`model` if it fits into `max_bytes` bytes, else its most visible Gaussians at the best SH degree.

    Raises UsageError if nothing fits.
    """
    if usual_size(model) <= max_bytes:
        return model
    candidates = []
    for degree in range(model.sh_degree + 1):
        truncated = kept = model.with_sh_degree(degree)
        while len(kept) and (size := encoded_size(kept)) > max_bytes:
            kept = most_visible(truncated, min(len(kept) - 1, int(0.995 * len(kept) * max_bytes / size)))
        candidates += [kept] if len(kept) else []
    if not candidates:
        raise UsageError(f"nothing of a secret fits into {max_bytes:,} bytes")
    return max(candidates, key=lambda candidate: psnr_between(model, candidate, viewpoints))


def usual_size(model: Gaussians) -> int:
    """About the bytes of `model` with the usual precision; see `encoded_size`."""
    if model not in _SIZES:
        _SIZES[model] = encoded_size(model)
    return _SIZES[model]


def finest_size(model: Gaussians) -> int:
    """About as many bytes as `model` takes with the finest precision."""
    numbers = 13 + 3 * (model.sh.shape[1] - 1)
    return usual_size(model) + int(_FINER * len(model) * numbers / 8)


def encode_to_size(
    model: Gaussians, max_bytes: int, *, short: bool = False, viewpoints: Viewpoints | None = None
) -> bytes:
    """Encode `model` in at most `max_bytes` bytes, up to the finest precision.

    `short`: use no more bytes than `choose_precision` needs. Raises UsageError if it does not fit.
    """
    usual = Precision.usual(model)
    finest = choose_precision(model, viewpoints) if short else usual.finer(_FINER)
    size = encoded_size(model, finest) if short or finest_size(model) > max_bytes else 0
    if size <= max_bytes and len(best := encode(model, finest)) <= max_bytes:
        return best
    octaves = _FINER * (max_bytes - usual_size(model)) / max(1, size - usual_size(model))
    while len(data := encode(model, usual.finer(max(0, octaves)))) > max_bytes:
        if octaves <= 0:
            raise UsageError(
                f"a secret of {len(model):,} Gaussians takes {len(data):,} bytes, and there is room for "
                f"{max_bytes:,}"
            )
        octaves -= 0.0625
    return data


def most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians with the largest opacity times size, in their order.

    Size is the square root of the cross-section, clamped to that of a typical large Gaussian: a few huge
    faint Gaussians must not replace all detail.
    """
    size = gaussians.log_scales.sort(dim=1).values[:, 1:].mean(1)  # log, of the larger two axes
    at_most = size.kthvalue(int(0.9 * len(size)) + 1).values
    visibility = gaussians.opacities * size.clamp_max(at_most).exp()
    return gaussians[visibility.topk(count).indices.sort().values]
