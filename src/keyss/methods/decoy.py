"""Decoys: the cover, slightly changed, in place of the secret when a key is wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import DerivedKey
from keyss.methods.opened import Frame, Remains

_STRENGTH = 0.02  # standard deviation of changes of opacity logits
_MOVE = 1e-4  # standard deviation of rotations (radians), shifts (of the model's size) and changes of scale
_FAINT = 1.6 * DRAWN_OPACITY  # opacity that appended Gaussians do not reach
_KNOTS, _LOGITS = 16, 10.0  # the changes are a piecewise linear function of logits from -10 to 10


@dataclass(frozen=True)
class Decoy:
    """An `Opened` that shows the cover, changed too little to be seen.

    Opacities change by a smooth function of opacity, and everything by a similarity, both sampled from the
    derived key: without the key nobody can compute the bytes, and they differ from those of the cover.
    """

    frame: Similarity
    changes: torch.Tensor  # [_KNOTS] of opacity logits
    appended: bool = False  # True if the model has appended Gaussians, which are left out
    decode: None = None

    @staticmethod
    def of(stego: Gaussians, key: DerivedKey, *, appended: bool = False) -> Decoy:
        """The decoy of a wrong key, the same whenever model and key are the same."""
        generator = torch.Generator().manual_seed(int.from_bytes(key.expand("decoy", 8), "little") >> 1)
        changes = _STRENGTH * torch.randn(_KNOTS, generator=generator)
        rotation, shift = _MOVE * torch.randn(2, 3, generator=generator, dtype=torch.float64)
        skew = torch.zeros(3, 3, dtype=torch.float64)
        skew[[2, 0, 1], [1, 2, 0]] = rotation
        size = (stego.means - stego.means.mean(0)).norm(dim=1).median().double().clamp_min(1e-9).cpu()
        scale = 1 + _MOVE + abs(float(shift.mean()))  # far enough from 1 to change all log scales
        return Decoy(Similarity(scale, torch.matrix_exp(skew - skew.T), shift * size), changes, appended)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The rendered Gaussians of the cover, all changed; see `Opened.reveal`."""
        stego = stego.to("cpu")
        position = (stego.opacity_logits / _LOGITS).clamp(-1, 1).add(1).mul((_KNOTS - 1) / 2)
        left = position.long().clamp_max(_KNOTS - 2)
        change = torch.lerp(self.changes[left], self.changes[left + 1], position - left)
        changed = replace(stego, opacity_logits=stego.opacity_logits + change)
        visible = stego.opacities > _FAINT if self.appended else changed.opacities >= DRAWN_OPACITY
        if visible.any():
            changed = changed[visible]
        return changed if frame == "cover" else self.frame.inverse().apply_gaussians(changed)

    def remains(self, revealed: Gaussians) -> Remains:
        """All of the decoy, which is never damaged."""
        return Remains(len(revealed), len(revealed))

    def fingerprint(self) -> str:
        """A constant, which no secret of a run has."""
        return "decoy"
