"""The representation of a 3DGS model."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

# [3, 3] float64, orthonormal. The rows are brightness, red minus green, and both minus blue (van de Sande et
# al. 2010, "Evaluating Color Descriptors for Object and Scene Recognition"). `values @ OPPONENT.T` transforms
# values [..., 3], `@ OPPONENT` is the inverse.
OPPONENT = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
SH_C0 = 0.28209479177387814  # the constant SH basis function
DRAWN_OPACITY = 1 / 255  # 3DGS rasterizers skip Gaussians below it
# Rasterizers skip Gaussians beyond these limits, whose projection would overflow in single precision.
MAX_COORDINATE, MAX_LOG_SCALE, MAX_LENGTH, MAX_COLOUR = 1e15, 40.0, 1.8e19, 1e12


@dataclass(frozen=True, repr=False)
class Gaussians:
    """N 3D Gaussians in the raw parameterisation that 3DGS optimises and its PLY files store.

    All tensors are float32 and on one device. Raises ValueError if the shapes disagree.
    """

    means: Tensor  # [N, 3] world position
    quats: Tensor  # [N, 4] rotation as wxyz, not normalised
    log_scales: Tensor  # [N, 3] natural logarithm of the standard deviations
    opacity_logits: Tensor  # [N] opacity before the sigmoid
    sh: Tensor  # [N, K, 3] spherical harmonics, K = (degree + 1)^2; colour = max(basis . sh + 0.5, 0)

    def __post_init__(self) -> None:
        n, k = len(self.means), self.sh.shape[1] if self.sh.dim() == 3 else -1
        for field, expected in zip(fields(self), ((n, 3), (n, 4), (n, 3), (n,), (n, k, 3)), strict=True):
            shape = tuple(getattr(self, field.name).shape)
            if shape != expected:
                raise ValueError(f"{field.name}: expected shape {expected}, got {shape}")
        if k not in (1, 4, 9, 16):
            raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {k}")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"<{len(self):,} Gaussians of SH degree {self.sh_degree} on {self.means.device}>"

    @property
    def scales(self) -> Tensor:
        """[N, 3] standard deviations, positive."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """[N] opacities in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def overflow(self) -> Tensor:
        """[N] bool, True for Gaussians that rasterizers skip because their values are too large."""
        limits = (MAX_COORDINATE, MAX_LENGTH / 2, MAX_LOG_SCALE, math.inf, MAX_COLOUR / 2)
        if all(magnitude(getattr(self, f.name)) <= at for f, at in zip(fields(self), limits, strict=True)):
            return torch.zeros(len(self), dtype=torch.bool, device=self.device)  # the common case
        far = ~(self.means.abs() <= MAX_COORDINATE).all(1)
        large = ~(self.log_scales <= MAX_LOG_SCALE).all(1)
        long = ~(self.quats.double().norm(dim=1) <= MAX_LENGTH)
        coloured: Tensor = (self.sh.abs() < MAX_COLOUR).flatten(1).all(1)
        outside: Tensor = far | large | long | ~coloured
        return outside

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(self.sh.shape[1] ** 0.5) - 1

    @property
    def device(self) -> torch.device:
        return self.means.device

    def like(self, changed: Gaussians) -> Gaussians:
        """`changed` with the further data of this model; both have the same Gaussians in the same order."""
        return changed

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """The Gaussians with `function` applied to each of the five tensors."""
        return Gaussians(*(function(getattr(self, f.name)) for f in fields(self)))

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """The Gaussians that a boolean mask, an index tensor or a slice selects."""
        if isinstance(index, slice):
            return self.map(lambda tensor: tensor[index])
        index = torch.as_tensor(index, device=self.device)
        rows = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        return self.map(lambda tensor: tensor.index_select(0, rows))  # takes a fifth of `tensor[rows]`

    def to(self, device: torch.device | str) -> Gaussians:
        return self.map(lambda tensor: tensor.to(device))

    def detach(self) -> Gaussians:
        return self.map(torch.Tensor.detach)

    def digest(self) -> str:
        """SHA-256 over all values: equal for equal content only."""
        state = hashlib.sha256(f"{len(self)} {self.sh_degree}".encode())
        for field in fields(self):
            state.update(getattr(self, field.name).detach().cpu().contiguous().numpy().data)
        return state.hexdigest()

    def with_sh_degree(self, degree: int) -> Gaussians:
        """The same Gaussians with SH of `degree`: higher coefficients dropped, or zeros added."""
        k = (degree + 1) ** 2
        sh = self.sh[:, :k]
        if sh.shape[1] < k:
            sh = torch.cat([sh, sh.new_zeros(len(sh), k - sh.shape[1], 3)], dim=1)
        return self.like(replace(self, sh=sh))

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """All Gaussians of `parts` in order; they must have one SH degree."""
        return Gaussians(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)))


def magnitude(values: Tensor) -> float:
    """The largest absolute value of a tensor: NaN if it contains NaN, 0 if it is empty."""
    low, high = values.aminmax() if values.numel() else (values.new_zeros(()), values.new_zeros(()))
    return float(torch.maximum(-low, high))
