"""Gaussians that carry bits, their IDs, and those that give the salts.

The bits go into the constant green and blue coefficients (`f_dc_1`, `f_dc_2`), which are the least visible
numbers to change among those that survive every format. The *ID* of a Gaussian is the indices of four *bins*:
of two ratios of its scales, its opacity and its red coefficient. Writing changes none of these, and none
depends on the model's position, rotation, scale or order.

Bins begin and end between the rounded values of 8-bit formats (`.spz`: log scales in sixteenths, colours in
steps of 1 / 38.25; most formats: opacities in 255ths), so rounding moves no number into another bin. Scaling
a model moves rounded values relative to the bins, so a reader tries several *alignments*.

*Salt Gaussians* have the smallest public hashes of their bins (opacity, ratios of scales, red), among the
Gaussians whose numbers no format can move into another bin. Half of them are opaque enough to survive the
removal of faint Gaussians. A salt of Argon2id is a hash of the bins of one salt Gaussian, green and blue
included. They are never written, because everybody finds them and would see the noise. Files of one cover
therefore have the same salts.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from keyss.channels.mixing import encrypted_blocks, row_hashes
from keyss.core.arrays import Doubles, Integers, Words, doubles
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, expand

_SCALE_STEPS, _COLOUR_STEPS, _OPACITY_STEPS = 16, 38.25, 255  # quantisation steps of 8-bit formats per unit
# Maximum rounding errors of formats in steps, taken as uniform noise.
_SCALE_NOISE, _COLOUR_NOISE, _OPACITY_NOISE = 0.144, 0.344, 1.02
_RATIO_BIN, _OPACITY_BIN, _RED_BIN = 4, 8, 3  # steps
_MIN_OPACITY = 2.5 / 255  # formats drop the colours of fainter Gaussians
_BINS = 30_000  # maximum absolute index, which fits into 16 bits
SALTS = 16  # maximum number; 5 to 12 survive rounding and random pruning of a quarter
_BANDS = (0.08, 0.4, 1.01)  # limits of two opacity bands with half of the salts each
_SALT_OPACITY_BIN, _SALT_RATIO_BIN, _SALT_COLOUR_BIN = 16, 8, 5  # steps
_LABEL = b"keyss/v1/colours-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()

Ids = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Carriers:
    """The C Gaussians of a model that can carry bits."""

    rows: Integers  # [C] indices into the model
    log_scales: Doubles  # [C, 3]
    opacities: Doubles  # [C]
    colours: Doubles  # [C, 3] constant coefficients
    ids: Ids  # [C, 4] bin indices: two ratios of scales, opacity, red
    error_probability: Doubles  # [C] that a format has changed the ID since writing

    @staticmethod
    def of(model: Gaussians, alignment: float = 0.0) -> Carriers:
        """The visible and finite Gaussians.

        `alignment`: offset of log scales, in steps, that compensates for a scaling of the model.
        """
        log_scales, colours = doubles(model.log_scales), doubles(model.sh[:, 0])
        opacities = doubles(model.opacities)
        fine = np.isfinite(log_scales).all(axis=1) & np.isfinite(colours).all(axis=1)
        rows = np.flatnonzero(fine & (opacities > _MIN_OPACITY))
        log_scales, colours, opacities = log_scales[rows], colours[rows], opacities[rows]
        whole, loose = _bins_of(log_scales * _SCALE_STEPS + 0.5 + alignment, 1, _SCALE_NOISE)
        ratios, edge = _bins_of(np.diff(whole, axis=1) + 0.5, _RATIO_BIN, 1.0)  # 1/4 next to a border
        opacity, faint = _bins_of(opacities[:, None] * _OPACITY_STEPS - 0.5, _OPACITY_BIN, _OPACITY_NOISE)
        red, off = _bins_of(colours[:, :1] * _COLOUR_STEPS, _RED_BIN, _COLOUR_NOISE)
        errors = np.hstack([2 * edge * (loose[:, 1:] + loose[:, :-1]), faint, off])
        ids = np.hstack([ratios, opacity, red]).astype(np.int16)
        return Carriers(rows, log_scales, opacities, colours, ids, 1 - (1 - errors).prod(axis=1))

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def impact(self) -> Doubles:
        """Visibility [C] of a colour change: log(area x opacity^2), with the opacity of the bin."""
        opacities = (self.ids[:, 2] + 0.5) * _OPACITY_BIN / _OPACITY_STEPS
        impact: Doubles = np.sort(self.log_scales)[:, 1:].sum(axis=1) + 2 * np.log(opacities.clip(1e-3))
        return impact

    @cached_property
    def stability(self) -> Doubles:
        """The probability [C] that a carrier has the ID with which it was written."""
        return 1 - self.error_probability

    @cached_property
    def shares(self) -> Doubles:
        """1 / the number [C] of carriers with the same ID."""
        _, inverse, counts = np.unique(row_hashes(self.ids), return_inverse=True, return_counts=True)
        shares: Doubles = 1 / counts[inverse]
        return shares

    @cached_property
    def certainty(self) -> Doubles:
        """The probability [C] that a carrier is the one of its ID that was written, with its ID unchanged."""
        return self.stability * self.shares

    @cached_property
    def weights(self) -> Doubles:
        """Weights [C] of carriers in the model: area x opacity, up to the mean; equal IDs count once."""
        sizes = np.exp(np.sort(self.log_scales)[:, 1:].sum(axis=1).clip(-80, 80)) * self.opacities
        weights: Doubles = np.minimum(1, sizes / max(1e-300, float(sizes.mean()))) * self.shares
        return weights

    @cached_property
    def representatives(self) -> Integers:
        """Indices [D] of one carrier per ID, the most stable one: only these are written."""
        order = np.argsort(self.error_probability, kind="stable")
        _, first = np.unique(row_hashes(self.ids)[order], return_index=True)
        return np.sort(order[first])


def find_salts(carriers: Carriers) -> tuple[Integers, list[bytes]]:
    """The salt Gaussians [S], as indices of carriers, and their salts."""
    ratios = np.diff(carriers.log_scales, axis=1) * _SCALE_STEPS - 0.5
    opacities = carriers.opacities[:, None] * _OPACITY_STEPS - 0.5
    parts = (
        _bins_of(opacities, _SALT_OPACITY_BIN, _OPACITY_NOISE),
        _bins_of(ratios, _SALT_RATIO_BIN, 1.0),
        _bins_of(carriers.colours * _COLOUR_STEPS, _SALT_COLOUR_BIN, _COLOUR_NOISE),
    )
    bins = np.hstack([part for part, _ in parts]).astype("<i2")
    stable = (np.hstack([error for _, error in parts])[:, :4] == 0).all(axis=1)
    hashes = fractions(_PUBLIC, "salt", bins[:, :4])[:, 0]
    chosen = []
    for low, high in pairwise(_BANDS):
        band = np.flatnonzero(stable & (carriers.opacities > low) & (carriers.opacities <= high))
        _, first = np.unique(hashes[band], return_index=True)
        chosen.append(band[first[: SALTS // (len(_BANDS) - 1)]])
    rows = np.concatenate(chosen)
    salts = [hashlib.sha256(_LABEL + bins[row].tobytes()).digest()[:SALT_BYTES] for row in rows]
    return rows, list(dict.fromkeys(salts))


def random_pairs(secret: bytes, label: str, ids: Ids) -> Words:
    """Words [C, 2] for `ids` [C, 4], pseudo-random without the secret: AES-256 of the IDs."""
    blocks = np.zeros((len(ids), 8), "<i2")
    blocks[:, : ids.shape[1]] = ids
    key = expand(secret, f"colours/{label}", 32)
    return encrypted_blocks(key, blocks.view(np.uint8)).view("<u8").astype(np.uint64)


def fractions(secret: bytes, label: str, ids: Ids) -> Doubles:
    """Pseudo-random numbers [C, 2] in [0, 1) for `ids` [C, 4]."""
    return (random_pairs(secret, label, ids) >> np.uint64(11)) / 2.0**53


def _bins_of(values: Doubles, steps: int, noise: float) -> tuple[Doubles, Doubles]:
    """Bins of `steps` steps for values [C, k] in steps; probabilities that noise changed the bin."""
    bins = np.floor(values / steps)
    inside = values - bins * steps
    nearest = np.minimum(inside, steps - inside)
    return bins.clip(-_BINS, _BINS), ((noise - nearest) / (2 * noise)).clip(0, 0.5)
