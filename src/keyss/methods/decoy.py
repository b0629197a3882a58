"""Decoys: with `reveal --decoy`, a wrong key opens the cover, encoded like a carried secret."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import torch

from keyss.channels import TYPICAL_SHARE, LowBitsCapacity
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import DerivedKey
from keyss.methods.hidden import Frame, HiddenScene
from keyss.methods.records import whole
from keyss.methods.records.lines import Table
from keyss.methods.records.quantise import Codec

_STRENGTH = 0.02  # standard deviation of changes of opacity logits
_MOVE = 1e-4  # standard deviation of rotation (radians), shift (relative to the model's size) and scale
_FAINT = 1.6 * DRAWN_OPACITY  # upper limit of opacities of appended Gaussians
_KNOTS, _LOGITS = 16, 10.0  # changes are piecewise linear in logits from -10 to 10
_FINER = -0.5  # octaves: about the precision of appended payloads
_MIN_SHARE = 0.8  # minimum share of the cover's Gaussians that are left


@dataclass(frozen=True)
class Decoy(HiddenScene):
    """Shows the cover, imperceptibly changed.

    A smooth function changes opacities, a similarity moves all Gaussians, and the faintest ones are removed.
    The derived key seeds these changes, so nobody can compute the bytes without it. The result is encoded and
    decoded like a carried secret, which quantises its numbers.
    """

    frame: Similarity
    changes: torch.Tensor  # [_KNOTS] of opacity logits
    share: float  # fraction of the rendered Gaussians that is left
    order: int  # seed of the order of records
    appended: bool = False  # True if the model has appended Gaussians, which are removed
    records: bool = True  # True if a secret would be records, else one payload

    @staticmethod
    def of(stego: Gaussians, key: DerivedKey, *, appended: bool = False, records: bool = True) -> Decoy:
        """The decoy for a wrong key, a deterministic function of model and key."""
        generator = torch.Generator().manual_seed(int.from_bytes(key.expand("decoy", 8), "little") >> 1)
        changes = _STRENGTH * torch.randn(_KNOTS, generator=generator)
        rotation, shift = _MOVE * torch.randn(2, 3, generator=generator, dtype=torch.float64)
        skew = torch.zeros(3, 3, dtype=torch.float64)
        skew[[2, 0, 1], [1, 2, 0]] = rotation
        size = (stego.means - stego.means.mean(0)).norm(dim=1).median().double().clamp_min(1e-9).cpu()
        scale = 1 + _MOVE + abs(float(shift.mean()))  # far enough from 1 to change all log scales
        share = 1 - (1 - _MIN_SHARE) * float(torch.rand((), generator=generator))
        order = int(torch.randint(1 << 62, (), generator=generator))
        frame = Similarity(scale, torch.matrix_exp(skew - skew.T), shift * size)
        return Decoy(frame, changes, share, order, appended, records)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The rendered Gaussians of the cover, all changed; see `HiddenScene.reveal`."""
        stego = stego.to("cpu")
        position = (stego.opacity_logits / _LOGITS).clamp(-1, 1).add(1).mul((_KNOTS - 1) / 2)
        left = position.long().clamp_max(_KNOTS - 2)
        change = torch.lerp(self.changes[left], self.changes[left + 1], position - left)
        changed = replace(stego, opacity_logits=stego.opacity_logits + change)
        visible = stego.opacities > _FAINT if self.appended else changed.opacities >= DRAWN_OPACITY
        if visible.any():
            changed = changed[visible]
        count = max(1, round(self.share * len(changed)))
        changed = changed[changed.opacity_logits.topk(count).indices.sort().values]
        if frame == "secret":
            changed = self.frame.inverse().apply_gaussians(changed)
        return self._encode_and_decode(changed, stego)

    def _encode_and_decode(self, model: Gaussians, stego: Gaussians) -> Gaussians:
        """Encode and decode `model` like a secret carried by `stego`."""
        capacity = LowBitsCapacity.of(int(TYPICAL_SHARE * len(stego)), stego.sh_degree)
        options = product(range(stego.sh_degree, -1, -1), (2, 1))  # SH degree, records per carrier
        found = (
            (cells, Table.of_size(8 * capacity.record_bytes(cells), degree)) for degree, cells in options
        )
        cells, table = next((each for each in found if each[1]), (0, None))
        if table is None or not self.records:
            precision = whole.Precision.usual(model)
            return whole.decode(whole.encode(model, precision.finer(_FINER * self.appended)))
        order = torch.randperm(len(model), generator=torch.Generator().manual_seed(self.order))
        model = model[order[: cells * capacity.carriers]].with_sh_degree(table.sh_degree)
        codec, outliers = Codec.fit(model, table)
        return codec.decode(codec.encode(model, outliers))

    def fingerprint(self) -> str:
        """A constant that differs from the fingerprint of every secret."""
        return "decoy"
