"""Models that were decoded from a .spz, .sog or compressed .ply, like most models on the web.

The quantised values of that file determine their low bits, so new low bits would show. `quantise` computes
these values from the floats. The secret is embedded in them, and the published model is decoded from them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Flags, Integers
from keyss.core.errors import OutputError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.codebooks import SIZE
from keyss.files.formats.common import CodedGaussians, Codes, is_in_morton_order
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import MAX_FRACTIONAL_BITS, MAX_POSITION, SpzCodes

_WRITTEN = ("means", "quats", "log_scales")  # attributes that carry bits in any format
_OPACITIES = 256  # different ones in any format, at most
_SAMPLE = 1024  # Gaussians of a first check
_CLOSE = 1e-5  # maximum relative difference between decoders
_MIN_EXACT = 0.9  # share of exact Gaussians


@dataclass(frozen=True)
class Decoded:
    """A model and the quantised values from which it was decoded."""

    model: Gaussians
    codes: Codes
    exact: Flags  # [N] True if decoding gives the Gaussian's numbers; others carry nothing
    order: Integers  # [N] position of each Gaussian in the file

    @staticmethod
    def of(model: Gaussians) -> Decoded | None:
        """None if the model was decoded from none of the formats."""
        if isinstance(model, CodedGaussians) or not len(model):
            return None
        for some in (model.opacity_logits[:_SAMPLE], model.opacity_logits):
            if len(some.detach().unique()) > _OPACITIES:
                return None
        model = model.detach().to("cpu")
        for quantise in (_spz, _sog, _compressed_ply):
            codes = quantise(model)
            if codes is not None:
                exact = _are_exact(model, codes.dequantise())
                if exact.mean() >= _MIN_EXACT:
                    return Decoded(model, codes, exact, np.arange(len(model)))
        return None

    def __getitem__(self, rows: Integers) -> Decoded:
        """The model's Gaussians in another order; `codes` are unchanged."""
        model = self.model[torch.from_numpy(rows)]
        return replace(self, model=model, exact=self.exact[rows], order=self.order[rows])

    @property
    def is_sorted(self) -> bool:
        """True if the file is in Morton order, up to a few Gaussians."""
        return is_in_morton_order(self.model.means.numpy()[self.order.argsort()])

    def with_codes(self, before: Codes, after: Codes) -> Gaussians:
        """The model after a change of its quantised values; both are in its order."""
        old, new = before.dequantise(), after.dequantise()
        changes = {}
        for name in _WRITTEN:
            values, was, now = (getattr(model, name) for model in (self.model, old, new))
            if name == "quats":
                now = now * _signs(values, was)
            changes[name] = torch.where((was == getattr(new, name)).all(1, keepdim=True), values, now)
        return replace(self.model, **changes)


def _spz(model: Gaussians) -> Codes | None:
    means, steps = model.means.numpy().astype(np.float64), model.log_scales.double() * 16
    if not torch.equal(steps, steps.round()):
        return None
    for bits in range(MAX_FRACTIONAL_BITS + 1):
        levels = np.ldexp(means, bits)
        if np.abs(levels).max() > MAX_POSITION:
            return None
        if (levels == levels.round()).all():
            return SpzCodes.quantise(model, fractional_bits=bits)
    return None


def _sog(model: Gaussians) -> Codes | None:
    """Without harmonics, which carry nothing."""
    few = len(np.unique(model.log_scales.numpy())) <= SIZE and len(np.unique(model.sh[:, 0].numpy())) <= SIZE
    return SogCodes.quantise(model.with_sh_degree(0)) if few else None


def _compressed_ply(model: Gaussians) -> Codes | None:
    try:
        return CompressedPlyCodes.quantise(model.with_sh_degree(0))
    except OutputError:
        return None


def _are_exact(model: Gaussians, decoded: Gaussians) -> Flags:
    """Mask [N] of Gaussians with the same attributes in both, up to differences between decoders."""
    signs = _signs(model.quats, decoded.quats)
    exact = ((model.quats - signs * decoded.quats).abs() < _CLOSE).all(1)
    for name in ("means", "log_scales"):
        values: Tensor = getattr(model, name)
        exact &= ((values - getattr(decoded, name)).abs() <= _CLOSE * values.abs()).all(1)
    flags: Flags = exact.numpy()
    return flags


def _signs(quats: Tensor, others: Tensor) -> Tensor:
    """[N, 1] 1 or -1: both signs of a quaternion mean one rotation."""
    return torch.where((quats * others).sum(1, keepdim=True) < 0, -1.0, 1.0)
