"""SOG, PlayCanvas's format with attributes in images: reads and writes version 2.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np

from keyss.core.arrays import Bytes, Doubles, Floats, Numbers, Shorts
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.files.formats import sog_bundle as bundle
from keyss.files.formats.codebooks import SIZE, codebook_of, nearest, palette_of
from keyss.files.formats.common import (
    Codes,
    arrays_of,
    check_count,
    check_sh_degree,
    from_smallest_three,
    gaussians_of,
    smallest_three,
    to_bytes,
)

_MAX_POSITION = 65535  # largest position code
_LARGEST = 252  # a quaternion's fourth byte: this plus the index (wxyz) of the component left out
_ROW = 64  # palette vectors per row of pixels
_MAX_LABELS = 65536


@dataclass(frozen=True, eq=False)
class SogCodes(Codes):
    """All values of a file."""

    name = "sog"

    mins: Doubles  # [3] bounds of positions, as sign(x) ln(|x| + 1)
    maxs: Doubles  # [3]
    positions: Shorts  # [N, 3] 65535ths between the bounds
    largest: Bytes  # [N] index of the component of wxyz left out
    rotations: Bytes  # [N, 3] the other components, from -sqrt(1/2) to sqrt(1/2)
    scale_codebook: Floats  # [256] log scales
    scales: Bytes  # [N, 3] codebook indices
    color_codebook: Floats  # [256] f_dc
    colors: Bytes  # [N, 3] codebook indices
    alphas: Bytes  # [N] opacities in 255ths
    sh_codebook: Floats  # [256] harmonics; [0] for degree 0
    palette: Bytes  # [P, K - 1, 3] codebook indices
    labels: Shorts  # [N] indices into the palette; 0 for degree 0

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """See `Codes`."""
        file = bundle.open_archive(data)
        meta = bundle.read_meta(file("meta.json"))
        n = meta.count
        check_count(n, len(data))

        def image(names: list[str], index: int = 0) -> Bytes:
            """[N, 4] the first N pixels, RGBA."""
            return bundle.decode_webp(file(names[index]), n)

        low, high = image(meta.means.files), image(meta.means.files, 1)
        quats, colors = image(meta.quats.files), image(meta.sh0.files)
        if (quats[:, 3] < _LARGEST).any():
            raise InputError("damaged SOG: expected 252 to 255 in the fourth channel of its quaternions")
        sh_codebook, palette, labels = _no_harmonics(n)
        if meta.shN is not None and meta.shN.bands:
            k = check_sh_degree(meta.shN.bands)
            sh_codebook = _codebook(meta.shN.codebook)
            pair = image(meta.shN.files, 1)
            labels = _uint16(pair[:, 0], pair[:, 1])
            if not int(labels.max()) < meta.shN.count <= _MAX_LABELS:
                raise InputError("damaged SOG: labels beyond the end of its palette")
            size = -(-meta.shN.count // _ROW) * _ROW
            rows = bundle.decode_webp(file(meta.shN.files[0]), size * k, width=_ROW * k)
            palette = rows[: meta.shN.count * k, :3].reshape(-1, k, 3).copy()
        return cls(
            mins=np.array(meta.means.mins, np.float64),
            maxs=np.array(meta.means.maxs, np.float64),
            positions=_uint16(low[:, :3], high[:, :3]),
            largest=quats[:, 3] - np.uint8(_LARGEST),
            rotations=quats[:, :3].copy(),
            scale_codebook=_codebook(meta.scales.codebook),
            scales=image(meta.scales.files)[:, :3].copy(),
            color_codebook=_codebook(meta.sh0.codebook),
            colors=colors[:, :3].copy(),
            alphas=colors[:, 3].copy(),
            sh_codebook=sh_codebook,
            palette=palette,
            labels=labels,
        )

    def serialise(self) -> bytes:
        n, (p, k) = len(self), self.palette.shape[:2]
        images = {
            "means_l.webp": _rgba(self.positions & 255),
            "means_u.webp": _rgba(self.positions >> 8),
            "quats.webp": _rgba(self.rotations, self.largest + np.uint8(_LARGEST)),
            "scales.webp": _rgba(self.scales),
            "sh0.webp": _rgba(self.colors, self.alphas),
        }
        if k:
            labels = np.stack([self.labels & 255, self.labels >> 8, np.zeros_like(self.labels)], axis=1)
            images["shN_labels.webp"] = _rgba(labels)
        width = math.ceil(math.sqrt(n) / 4) * 4
        height = math.ceil(n / width / 4) * 4
        files = {name: bundle.encode_webp(pixels, width, height) for name, pixels in images.items()}
        harmonics = None
        if k:
            palette = _rgba(self.palette.reshape(-1, 3))
            files["shN_centroids.webp"] = bundle.encode_webp(palette, _ROW * k, -(-p // _ROW))
            names = ["shN_centroids.webp", "shN_labels.webp"]
            harmonics = bundle.Harmonics(p, {3: 1, 8: 2, 15: 3}[k], self.sh_codebook.tolist(), names)
        meta = bundle.Meta(
            version=2,
            count=n,
            means=bundle.Means(self.mins.tolist(), self.maxs.tolist(), ["means_l.webp", "means_u.webp"]),
            scales=bundle.Book(self.scale_codebook.tolist(), ["scales.webp"]),
            quats=bundle.Images(["quats.webp"]),
            sh0=bundle.Book(self.color_codebook.tolist(), ["sh0.webp"]),
            shN=harmonics,
        )
        return bundle.pack_archive({**files, "meta.json": msgspec.json.encode(meta)})

    @classmethod
    def quantise(cls, model: Gaussians) -> Self:
        """See `Codes`. The palette has N / 2 to N vectors, at most 65,536."""
        means, quats, log_scales, opacities, f_dc, rest = arrays_of(model)
        n, k = rest.shape[:2]
        logs = np.copysign(np.log1p(np.abs(means.astype(np.float64))), means)
        mins, maxs = logs.min(axis=0), logs.max(axis=0)
        positions = (logs - mins) / np.where(maxs > mins, maxs - mins, 1.0) * _MAX_POSITION
        largest, others = smallest_three(quats)
        scale_codebook, color_codebook = codebook_of(log_scales), codebook_of(f_dc)
        sh_codebook, palette, labels = _no_harmonics(n)
        if k:
            size = min(_MAX_LABELS, 2 ** int(math.log2(n)))
            vectors, labels = palette_of(rest.reshape(n, 3 * k), size)
            sh_codebook = codebook_of(vectors)
            palette = nearest(sh_codebook, vectors).reshape(-1, k, 3)
        return cls(
            mins=mins,
            maxs=maxs,
            positions=to_bytes(positions, _MAX_POSITION),
            largest=largest,
            rotations=to_bytes((others * np.sqrt(2) + 1) / 2 * 255),
            scale_codebook=scale_codebook,
            scales=nearest(scale_codebook, log_scales),
            color_codebook=color_codebook,
            colors=nearest(color_codebook, f_dc),
            alphas=to_bytes(opacities * 255),
            sh_codebook=sh_codebook,
            palette=palette,
            labels=labels,
        )

    def dequantise(self) -> Gaussians:
        rotations = (self.rotations / 255 * 2 - 1) * np.sqrt(0.5)
        palette = self.sh_codebook[self.palette] if self.palette.size else np.empty((1, 0, 3), np.float32)
        return gaussians_of(
            self.positions_at(self.positions),
            from_smallest_three(self.largest, rotations),
            self.scale_codebook[self.scales],
            self.alphas / 255,
            self.color_codebook[self.colors],
            palette[self.labels],
        )

    def positions_at(self, levels: Numbers) -> Doubles:
        """[N, 3] world positions of codes `levels`, 0 to 65535, which may be fractional."""
        extent = np.where(self.maxs == self.mins, 1.0, self.maxs - self.mins)
        logs = self.mins + extent * (levels / _MAX_POSITION)
        with np.errstate(over="ignore"):
            found: Doubles = np.copysign(np.expm1(np.abs(logs)), logs)
        return found


def _no_harmonics(count: int) -> tuple[Floats, Bytes, Shorts]:
    """Codebook, palette and labels of degree 0."""
    return np.empty(0, np.float32), np.empty((1, 0, 3), np.uint8), np.zeros(count, np.uint16)


def _codebook(values: list[float]) -> Floats:
    """[256] finite numbers, padded with 0. Raises InputError."""
    if len(values) > SIZE:
        raise InputError(f"damaged SOG: expected codebooks of at most {SIZE} numbers, found {len(values):,}")
    with np.errstate(over="ignore"):
        numbers = np.pad(np.array(values, np.float64), (0, SIZE - len(values))).astype(np.float32)
    if not np.isfinite(numbers).all():
        raise InputError("damaged SOG: a codebook is not finite")
    return numbers


def _uint16(low: Bytes, high: Bytes) -> Shorts:
    """16-bit integers from their low and high bytes."""
    return low.astype(np.uint16) | (high.astype(np.uint16) << np.uint16(8))


def _rgba(colors: Numbers, alpha: Bytes | None = None) -> Bytes:
    """[M, 4] pixels from colours [M, 3], 0 to 255, and an alpha [M], by default 255."""
    found = np.full((len(colors), 4), 255, np.uint8)
    found[:, :3] = colors
    if alpha is not None:
        found[:, 3] = alpha
    return found
