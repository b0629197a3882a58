"""antimatter15's .splat: 32 bytes per Gaussian, no header, no harmonics.

https://github.com/antimatter15/splat. Positions and scales are floats; opacity, rotation and colours, which
are clipped, are bytes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from keyss.core.errors import not_whole
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import (
    arrays_of,
    assembled,
    blocks_of,
    colour_bytes,
    f_dc_of,
    gaussians_of,
    log_scales_of,
    scales_of,
    to_bytes,
    unit,
    writable,
)

_ROW = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1"), ("quat", "u1", 4)]
)


def read(data: bytes) -> Gaussians:
    """The model in a file, of SH degree 0. Raises InputError."""
    if not data or len(data) % _ROW.itemsize:
        raise not_whole(".splat", f"expected 32 bytes per Gaussian, found {len(data):,} in total")
    rows = np.frombuffer(data, _ROW)
    return assembled(len(rows), (_gaussians(rows[part]) for part in blocks_of(len(rows))), drop=True)


def _gaussians(rows: npt.NDArray[np.void]) -> Gaussians:
    return gaussians_of(
        rows["mean"],
        unit(rows["quat"].astype(np.float64) / 128 - 1),
        log_scales_of(rows["scale"]),
        rows["alpha"] / 255,
        f_dc_of(rows["rgb"] / 255),
        np.empty((len(rows), 0, 3), np.float32),
    )


def write(model: Gaussians) -> bytes:
    """A model as a file, most visible Gaussians first, since viewers show files while they load."""
    means, quats, log_scales, opacities, f_dc, _ = arrays_of(writable(model))
    size = np.exp(log_scales.astype(np.float64).sum(axis=1))
    order = np.argsort(-opacities * size, kind="stable")
    rows = np.empty(len(model), _ROW)
    rows["mean"], rows["scale"] = means, scales_of(log_scales)
    rows["rgb"], rows["alpha"] = colour_bytes(f_dc), to_bytes(opacities * 255)
    rows["quat"] = to_bytes(quats * 128 + 128)
    return rows[order].tobytes()
