"""Dithering: new low bits for models that were stored in a coarser format.

If a property has few distinct values, as after quantisation to 8 or 16 bits, or non-uniform low bits, as
after adding an offset, each value moves by a random amount below half of the distance to the nearest other
value: less than the precision of the format, which would round it back. An expert can detect the dithering,
since trained values are distributed differently, but not whether low bits carry anything.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from keyss.channels import chance_of_bits
from keyss.core.arrays import Doubles, Flags, Floats
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import stream

_BITS, _CHANCE = 9, 1e-6  # low bits tested for randomness, and the minimum p-value
_FEW = 0.8  # distinct values / values of a quantised property, at most; above 0.95 in trained models
_SPARSE = 0.1  # distinct values / values above which a format's steps are finer than gaps in the data
_TYPICAL = 0.9  # quantile of the distances; larger ones are gaps in the data
_SAMPLE = 20_000  # Gaussians
_UNIT = 1e-5  # the largest difference between 1 and the length of a unit quaternion
_FAINT = 1e-3  # standard deviation of new harmonics
_LOOSE = {"log_scales": 0.01, "quats": 0.01, "opacity_logits": 0.01, "sh": _FAINT}  # standard deviations


def dither_model(model: Gaussians, entropy: bytes) -> Gaussians:
    """`model` with new low bits where they are not random; positions and constant colours do not change.

    `entropy`: 32 secret bytes. Properties with a single value do not change, nor do quaternions of unit
    length (see `keyss.channels.quiet.bits`).
    """
    changed = {}
    unit = (model.quats.detach().cpu().double().norm(dim=1) - 1).abs() < _UNIT
    for name in ("log_scales", "quats", "opacity_logits", "sh"):
        values = getattr(model, name).detach().cpu().clone(memory_format=torch.contiguous_format)
        columns = values.view(len(values), -1).numpy()
        for column in range(3 if name == "sh" else 0, columns.shape[1]):
            if not _is_natural(columns[:, column]):
                random = stream(entropy, f"dither/{name}/{column}", 8 * len(columns))
                noise = np.frombuffer(random, "<u8").astype(np.float64) / 2.0**63 - 1
                columns[:, column] = _dither(columns[:, column], noise)
        if name == "quats":
            values[unit] = model.quats.detach().cpu()[unit]
        changed[name] = values
    return Gaussians(means=model.means, **changed)


def raise_degree(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` with harmonics up to `sh_degree`; new ones are random and imperceptible.

    (Zeros have no replaceable low bits.) A model of this degree or more does not change.
    """
    count = 3 * ((sh_degree + 1) ** 2 - model.sh.shape[1])
    if count <= 0:
        return model
    seed = int.from_bytes(stream(entropy, "dither/raised", 8), "little") >> 1
    generator = torch.Generator().manual_seed(seed)
    # Scale before rounding: products in single precision keep a trace of their factor.
    noise = _FAINT * torch.randn(len(model), count // 3, 3, generator=generator, dtype=torch.float64)
    return replace(model, sh=torch.cat([model.sh, noise.to(model.sh)], dim=1))


def add_noise(model: Gaussians, usable: Flags, entropy: bytes) -> Gaussians:
    """Add small noise to Gaussians that are not `usable` [N]; positions do not change.

    After few training steps, many Gaussians still have equal scales, grey colours or no harmonics, whose low
    bits cannot be replaced. Quaternions do not change if most have unit length.
    """
    rows = torch.from_numpy(np.flatnonzero(~usable))
    seed = int.from_bytes(stream(entropy, "dither/loosened", 8), "little") >> 1
    generator = torch.Generator().manual_seed(seed)
    lengths = model.quats.detach().cpu().double().norm(dim=1)
    unit = float((lengths - 1).abs().median()) < _UNIT
    changed = {}
    for name, size in _LOOSE.items():
        values = getattr(model, name).detach().cpu().clone()
        noise = size * torch.randn(values[rows].shape, generator=generator, dtype=torch.float64)
        if name == "sh":
            noise[:, 0] = 0
        if not (name == "quats" and unit):
            values[rows] = (values[rows] + noise).to(values)
        changed[name] = values
    return replace(model, **changed)


def _is_natural(values: Floats) -> bool:
    """True if all bits of the values look random, except for a few zeros, which training leaves too."""
    measured = values[values != 0]
    if len(measured) > _FEW * len(values):
        values = measured
    if len(np.unique(values)) <= _FEW * len(values):
        return False
    words = np.ascontiguousarray(values[:: max(1, len(values) // _SAMPLE)]).view(np.uint32)
    return chance_of_bits(words, _BITS) > _CHANCE


def _dither(values: Floats, noise: Doubles) -> Floats:
    """`values` moved by `noise` in [-1, 1] times half of the distance to the nearest other value."""
    unique, inverse = np.unique(values.astype(np.float64), return_inverse=True)
    if len(unique) < 2:
        return values
    gaps = np.diff(unique)
    reach = np.minimum(np.append(gaps, np.inf), np.insert(gaps, 0, np.inf))
    reach = np.minimum(reach, np.quantile(gaps, _TYPICAL)) / 2
    half = unique.astype(np.float16)
    if len(unique) > _SPARSE * len(values) and (half == unique).all():
        # Half precision with gaps: the nearest other value may be several steps away.
        reach = np.minimum(reach, np.spacing(np.abs(half)).astype(np.float64) / 2)
    moved: Floats = (values + noise * reach[inverse]).astype(np.float32)
    return moved
