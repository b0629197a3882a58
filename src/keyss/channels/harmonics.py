"""Real numbers in the harmonics of a model, in the directions of least variance.

Every Gaussian holds a *rank* in (0, 1) in each of R directions. The coefficient written there is the quantile
of that rank in the distribution of a plain model, conditioned on the Gaussian's other harmonics: uniform
ranks give the distribution of a plain model. Harmonics up to KEPT_DEGREE stay, so their low bits are free.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from keyss.channels.quiet.bits import gaussian_ids
from keyss.channels.quiet.cells import CellCipher
from keyss.core.arrays import Bytes, Doubles, Flags, doubles
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians

KEPT_DEGREE = 1
# Probabilities of the quantiles that describe a distribution, denser at the ends.
RANKS = np.concatenate([[0.0], 1 / (1 + np.exp(-np.linspace(-7, 7, 31))), [1.0]])
_ROUNDING = 1e-10  # relative squared norm that rounding leaves in empty directions


def harmonics_above(sh_degree: int) -> int:
    """H, the number of coefficients above KEPT_DEGREE, of three colours."""
    return max(0, 3 * ((sh_degree + 1) ** 2 - (KEPT_DEGREE + 1) ** 2))


def high_harmonics(model: Gaussians) -> Doubles:
    """The harmonics [N, H] above KEPT_DEGREE."""
    return doubles(model.sh[:, (KEPT_DEGREE + 1) ** 2 :].flatten(1))


def with_high_harmonics(model: Gaussians, harmonics: Doubles) -> Gaussians:
    """`model` with new harmonics [N, H] above KEPT_DEGREE."""
    high = torch.from_numpy(harmonics).to(model.sh).view(len(model), -1, 3)
    return replace(model, sh=torch.cat([model.sh[:, : (KEPT_DEGREE + 1) ** 2], high], dim=1))


def row_ids(model: Gaussians) -> Bytes:
    """The ID [N, 16] of each Gaussian, independent of harmonics and low bits."""
    return gaussian_ids(model.with_sh_degree(0))


def pads(secret: bytes, ids: Bytes, count: int) -> Doubles:
    """Numbers [N, count] in [0, 1): a pseudo-random function of a secret and each Gaussian's ID."""
    size = 4 * count
    stream = CellCipher(secret, "pad", size).encrypt(ids, np.zeros((len(ids), size), np.uint8))
    return np.ascontiguousarray(stream[:, -size:]).view("<u4") / 2.0**32


class Harmonics(nn.Module):
    """R directions, and the distribution of a plain model's coefficients in them."""

    directions: Tensor  # [H, R] orthonormal
    # [3, R] a, b, c: coefficient j has the spread exp(a + b log(kept) + c log(before)), from the root mean
    # squares of the unchanged directions and of coefficients 0 to j - 1
    slopes: Tensor
    quantiles: Tensor  # [R, 33] of coefficient / spread, at RANKS

    def __init__(self, width: int, count: int) -> None:
        super().__init__()
        self.register_buffer("directions", torch.zeros(width, count))
        self.register_buffer("slopes", torch.zeros(3, count))
        self.register_buffer("quantiles", torch.linspace(-1, 1, len(RANKS)).repeat(count, 1))

    def fit(self, plain: Gaussians) -> Tensor:
        """Fit to a plain model; returns the unchanged directions [H, H - R].

        Raises InputError for a model with hardly any harmonics.
        """
        harmonics = high_harmonics(plain)
        chosen = (harmonics != 0).any(axis=1)
        if chosen.sum() < len(RANKS):
            raise InputError(
                "hardly any Gaussian of the cover's plain model has harmonics above degree 1, which hide the "
                'secret: train longer, or use `method="carry"`'
            )
        harmonics = harmonics[chosen]
        weighted = harmonics * doubles(plain.opacities)[chosen, None]
        vectors = np.linalg.eigh(weighted.T @ weighted)[1]
        count = self.directions.shape[1]
        self.directions.copy_(torch.from_numpy(vectors[:, :count]))
        written, kept = self._split(harmonics)
        before = np.zeros_like(kept)
        for j, column in enumerate(written.T):
            seen = (kept > 0) & (column != 0)
            levels = self._levels(kept[seen], before[seen], j)
            solution = np.linalg.lstsq(levels, np.log(np.abs(column[seen])), rcond=None)[0]
            self.slopes[:, j] = torch.from_numpy(solution)
            spread = self._spread(kept[seen], before[seen], j)
            self.quantiles[j] = make_increasing(np.quantile(column[seen] / spread, RANKS))
            before = before + column**2
        return torch.from_numpy(vectors[:, count:]).float()

    def write(self, harmonics: Doubles, ranks: Doubles) -> Doubles:
        """Write `ranks` [N, R] into `harmonics` [N, H].

        Rows that are zero in all other directions, because no view ever showed them, do not change.
        """
        directions = doubles(self.directions)
        kept = harmonics - (harmonics @ directions) @ directions.T
        power = (kept**2).sum(axis=1)
        alive, written, before = power > 0, np.zeros_like(ranks), np.zeros(len(ranks))
        power = np.where(alive, power, 1.0)
        for j, own in enumerate(ranks.T):
            value = np.interp(own, RANKS, doubles(self.quantiles[j]))
            written[:, j] = value * self._spread(power, before, j)
            before = before + written[:, j] ** 2
        return np.where(alive[:, None], kept + written @ directions.T, harmonics)

    def read(self, harmonics: Doubles) -> tuple[Doubles, Flags]:
        """The ranks [N, R] from `write`, and a mask [N] of the rows that have any."""
        written, power = self._split(harmonics)
        alive, ranks, before = power > 0, np.empty_like(written), np.zeros(len(written))
        power = np.where(alive, power, 1.0)
        for j, column in enumerate(written.T):
            relative = column / self._spread(power, before, j)
            ranks[:, j] = np.interp(relative, doubles(self.quantiles[j]), RANKS)
            before = before + column**2
        return ranks, alive

    def _split(self, harmonics: Doubles) -> tuple[Doubles, Doubles]:
        """The coefficients [N, R] in the directions, and the squared norm [N] of the rest."""
        directions = doubles(self.directions)
        written = harmonics @ directions
        power = ((harmonics - written @ directions.T) ** 2).sum(axis=1)
        return written, np.where(power > _ROUNDING * (harmonics**2).sum(axis=1), power, 0.0)

    def _levels(self, kept: Doubles, before: Doubles, j: int) -> Doubles:
        """Regressors [N, 3] of `slopes` for coefficient j, from sums of squares [N]: 1 and two logarithms."""
        width, count = self.directions.shape
        own = np.zeros_like(kept) if j == 0 else np.log(np.maximum(before, _ROUNDING * kept) / j) / 2
        return np.stack([np.ones_like(kept), np.log(kept / (width - count)) / 2, own], axis=1)

    def _spread(self, kept: Doubles, before: Doubles, j: int) -> Doubles:
        exponents = self._levels(kept, before, j) @ doubles(self.slopes[:, j])
        spread: Doubles = np.exp(np.clip(exponents, -80, 80))
        return spread


def make_increasing(values: Doubles) -> Tensor:
    """Sorted `values` [33] as float32, made strictly increasing."""
    span = max(float(np.ptp(values)), float(np.abs(values).max()), 1e-6)
    return torch.from_numpy(values + span * 1e-5 * np.arange(len(values))).float()
