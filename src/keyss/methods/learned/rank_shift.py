"""The keyed rank shift: encryption of what a secret's transparent Gaussians show when made visible.

A Gaussian that the cover never draws need not show where it is. Position, scales, colour and opacity of each
are published as other values, as frequent as among the cover's visible Gaussians. Let u in [0, 1) be the rank
of the true value among the secret's, and r a number that only the key gives for this Gaussian: published is
the value of rank u + r mod 1 of the cover. r is uniform, so u + r mod 1 says nothing of u (a one-time pad).

r is derived from the Gaussian's own rotation and higher harmonics, which stay, except for the low bits that
payloads are written to. Therefore neither order nor loss of others matters, and no format that rounds
survives.
Gaussians whose rotation and harmonics are equal (clones that training never moved) share their r.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg import block_diag

from keyss.core.colour import OPPONENT
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians

KNOTS = 65
CHANNELS = 10  # means, log scales, constant colour, opacity logit
KEY_BYTES = 32
# Above the bits that payloads are written to: nine of a quaternion, thirteen of a harmonic.
_QUAT_BITS, _SH_BITS = np.uint32(0xFFFFFE00), np.uint32(0xFFFFE000)
_RANK_BYTES = 6  # of keyed BLAKE2b for each channel
# Neighbouring knots of what is published lie so far apart, relative to their size, that float32 resolves
# a rank to 2^-22.
_LEAST_GAP = 2.0**-9
# Ranks are kept this far from 0 and 1, which the shift makes neighbours: rounding must not lead from one end
# of the secret's values to the other. Low bits that are overwritten move opacity logits most: those between
# 16 and 32 by 2^-10, in bands 2.6 wide.
_MARGIN = 2.0**-11
_FARTHEST = 8.0  # an outlier is as many times further from the median than 95 % are

# [CHANNELS, CHANNELS] orthonormal: three log scales and three colours become a sum and two differences each.
_TAKING_APART = block_diag(np.eye(3), OPPONENT, OPPONENT, 1.0)

Table = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RankShift:
    """What it takes to put the Gaussians of one secret back."""

    key: bytes
    band: tuple[float, float]  # opacity logits between which the secret's Gaussians lie
    own: torch.Tensor  # [CHANNELS, KNOTS] float32 values of the secret's Gaussians at equal steps of rank
    shown: torch.Tensor  # [CHANNELS, KNOTS] the same of what is published

    @staticmethod
    def of(stego: Gaussians, key: bytes, band: tuple[float, float]) -> RankShift:
        """For the Gaussians of `stego` whose opacity logits lie in `band`; `key` has KEY_BYTES."""
        hidden = _inside(stego, band)
        visible = stego.opacities >= DRAWN_OPACITY
        own = _quantiles(_channels(stego[hidden]))
        shown = _quantiles(_bulk(_channels(stego[visible if visible.any() else hidden])))
        shown = _ascending(shown, _least_gaps(shown))
        shown[-1] = np.linspace(own[-1, 0], own[-1, -1], KNOTS)  # as transparent as they are
        tables = (torch.from_numpy(np.ascontiguousarray(table)).float() for table in (own, shown))
        return RankShift(key, band, *tables)

    def encrypt(self, stego: Gaussians) -> Gaussians:
        """`stego` with this secret's Gaussians as they are published."""
        return self._moved(stego, 1)

    def decrypt(self, stego: Gaussians) -> Gaussians:
        """What `encrypt` was given, to the precision of float32."""
        return self._moved(stego, -1)

    def _moved(self, stego: Gaussians, sign: int) -> Gaussians:
        hidden = _inside(stego, self.band)
        part = stego[hidden].to("cpu")
        values, shift = _channels(part), self._shifts(part)
        ranks = np.linspace(0, 1, KNOTS)
        moved = np.empty_like(values)
        inner = _MARGIN + (1 - 2 * _MARGIN) * ranks
        for channel in range(CHANNELS):
            own, shown = self.own[channel].double().numpy(), self.shown[channel].double().numpy()
            centre, spread = own[KNOTS // 2], (own[3 * KNOTS // 4] - own[KNOTS // 4]) / 2
            own = np.arcsinh((own - centre) / spread)
            if sign > 0:
                rank = np.interp(np.arcsinh((values[:, channel] - centre) / spread), own, inner)
                moved[:, channel] = np.interp((rank + shift[:, channel]) % 1.0, ranks, shown)
            else:
                rank = np.interp(values[:, channel], shown, ranks)
                position = np.interp((rank - shift[:, channel]) % 1.0, inner, own)
                moved[:, channel] = centre + spread * np.sinh(position)
        columns = torch.from_numpy(moved @ _TAKING_APART).float().to(stego.device)
        means, log_scales, sh = stego.means.clone(), stego.log_scales.clone(), stego.sh.clone()
        opacity_logits = stego.opacity_logits.clone()
        means[hidden], log_scales[hidden], sh[hidden, 0] = columns[:, 0:3], columns[:, 3:6], columns[:, 6:9]
        opacity_logits[hidden] = columns[:, 9]
        return replace(stego, means=means, log_scales=log_scales, sh=sh, opacity_logits=opacity_logits)

    def _shifts(self, part: Gaussians) -> Table:
        """[N, CHANNELS] in [0, 1), uniform and independent for who does not have the key."""
        quats = part.quats.contiguous().numpy().view(np.uint32) & _QUAT_BITS
        harmonics = part.sh[:, 1:].flatten(1).contiguous().numpy().view(np.uint32) & _SH_BITS
        rows = np.concatenate([quats, harmonics], axis=1).astype("<u4")
        drawn = b"".join(
            hashlib.blake2b(
                row.tobytes(), digest_size=CHANNELS * _RANK_BYTES, key=self.key, person=b"keyss/rank-shift"
            ).digest()
            for row in rows
        )
        parts = np.frombuffer(drawn, np.uint8).reshape(len(rows), CHANNELS, _RANK_BYTES).astype(np.float64)
        shifts: Table = parts @ (256.0 ** -np.arange(1, _RANK_BYTES + 1))
        return shifts


def match_quaternion_lengths(stego: Gaussians, band: tuple[float, float]) -> Gaussians:
    """`stego` with quaternions in `band` as long as those of visible Gaussians: the n-th longest as theirs.

    A length changes nothing that is drawn, but training leaves other ones in another scene.
    """
    hidden, visible = _inside(stego, band), stego.opacities >= DRAWN_OPACITY
    if not hidden.any() or not visible.any():
        return stego
    lengths = stego.quats.norm(dim=1)
    own, shown = lengths[hidden], lengths[visible].sort().values
    ranks = own.argsort().argsort() * (len(shown) - 1) // max(len(own) - 1, 1)
    quats = stego.quats.clone()
    quats[hidden] *= (shown[ranks] / own.clamp_min(1e-12))[:, None]
    return replace(stego, quats=quats)


def _inside(stego: Gaussians, band: tuple[float, float]) -> torch.Tensor:
    return (stego.opacity_logits > band[0]) & (stego.opacity_logits < band[1])


def _channels(part: Gaussians) -> Table:
    """[N, CHANNELS] positions, log scales and colours taken apart, opacity logits.

    Log scales and colours of a Gaussian go together: large ones are large along all axes, bright ones bright
    in all channels. Their sum and two differences are shifted each by itself, so that what is published looks
    like Gaussians and colours of the cover.
    """
    columns = [part.means, part.log_scales, part.sh[:, 0], part.opacity_logits[:, None]]
    values: Table = torch.cat(columns, dim=1).detach().cpu().double().numpy()
    apart: Table = values @ _TAKING_APART.T
    return apart


def _bulk(values: Table) -> Table:
    """`values` with NaN for outliers: else every 64th of what is published would lie between them and the
    rest."""
    if len(values) == 0:
        return values
    distance = np.abs(values - np.median(values, axis=0))
    return np.where(
        distance > _FARTHEST * np.quantile(distance, 0.95, axis=0, method="lower"), np.nan, values
    )


def _quantiles(values: Table) -> Table:
    """[CHANNELS, KNOTS] values at equal steps of rank, strictly ascending; NaNs are left out."""
    if len(values) == 0:
        return np.tile(np.linspace(0, 1, KNOTS), (CHANNELS, 1))
    found = np.nanquantile(values, np.linspace(0, 1, KNOTS), axis=0).T
    sizes = np.maximum(np.abs(found[:, :-1]), np.abs(found[:, 1:]))
    return _ascending(found, 2.0**-22 * (sizes + np.median(np.abs(found), axis=1, keepdims=True) + 1e-6))


def _least_gaps(shown: Table) -> Table:
    """[CHANNELS, KNOTS - 1] what must lie between neighbouring knots for float32 to resolve ranks.

    What was taken apart is rounded together: the largest value of the three counts, however small the others.
    """
    sizes = np.maximum(np.abs(shown[:, :-1]), np.abs(shown[:, 1:]))
    for group in (slice(3, 6), slice(6, 9)):
        sizes[group] = np.median(np.abs(shown[group]), axis=1).max()
    return _LEAST_GAP * sizes + 1e-9


def _ascending(table: Table, least: Table) -> Table:
    """`table` with at least this much from knot to knot."""
    gaps = np.maximum(np.diff(table, axis=1), least)
    return np.concatenate([table[:, :1], table[:, :1] + gaps.cumsum(axis=1)], axis=1)
