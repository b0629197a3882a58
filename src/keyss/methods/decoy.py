"""Decoys: what a wrong key opens for whoever looks on, whichever method hid the secret."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import DerivedKey
from keyss.methods.opened import Frame, Remains

_STRENGTH = 0.02  # standard deviation of the changes of opacity logits
_MOVE = 1e-4  # of turns (radians), shifts (of the model's size) and changes of scale
_FAINT = 1.6 * DRAWN_OPACITY  # appended Gaussians are below it
_KNOTS, _LOGITS = 16, 10.0  # the changes are a piecewise linear function of logits from -10 to 10


@dataclass(frozen=True)
class Decoy:
    """An `Opened` that shows the cover, changed too little to be seen.

    Opacities change by a smooth function of opacity and everything by a similarity, both drawn from the
    derived key: who does not have the key cannot compute the bytes, and they are not those of the cover.
    """

    frame: Similarity
    changes: torch.Tensor  # [_KNOTS] of opacity logits
    appended: bool = False  # whether there are Gaussians that are no part of the cover
    decode: None = None

    @staticmethod
    def of(stego: Gaussians, key: DerivedKey, *, appended: bool = False) -> Decoy:
        """The decoy of a wrong key: the same model and key give the same."""
        generator = torch.Generator().manual_seed(int.from_bytes(key.expand("decoy", 8), "little") >> 1)
        changes = _STRENGTH * torch.randn(_KNOTS, generator=generator)
        turn, shift = _MOVE * torch.randn(2, 3, generator=generator, dtype=torch.float64)
        skew = torch.zeros(3, 3, dtype=torch.float64)
        skew[[2, 0, 1], [1, 2, 0]] = turn
        size = (stego.means - stego.means.mean(0)).norm(dim=1).median().double().clamp_min(1e-9).cpu()
        scale = 1 + _MOVE + abs(float(shift.mean()))  # never so near to 1 that log scales stay the same
        return Decoy(Similarity(scale, torch.matrix_exp(skew - skew.T), shift * size), changes, appended)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The drawn Gaussians of the cover, all changed; see `Opened.reveal`."""
        stego = stego.to("cpu")
        place = (stego.opacity_logits / _LOGITS).clamp(-1, 1).add(1).mul((_KNOTS - 1) / 2)
        left = place.long().clamp_max(_KNOTS - 2)
        change = torch.lerp(self.changes[left], self.changes[left + 1], place - left)
        shown = replace(stego, opacity_logits=stego.opacity_logits + change)
        drawn = shown.opacities >= DRAWN_OPACITY
        if self.appended:
            drawn = stego.opacities > _FAINT
        if drawn.any():
            shown = shown[drawn]
        return shown if frame == "cover" else self.frame.inverse().apply_gaussians(shown)

    def remains(self, revealed: Gaussians) -> Remains:
        """All of it: a decoy is never damaged."""
        return Remains(len(revealed), len(revealed))

    def fingerprint(self) -> str:
        """Of a decoy there is none that a run could know."""
        return "decoy"
