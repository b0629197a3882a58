"""Reader and writer of 3DGS models in the Inria PLY layout.

One vertex is one Gaussian: x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3,
raw parameters as `Gaussians` holds them; f_rest is channel-major (all red coefficients, then green,
then blue).
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
import torch

from keyss.core import Gaussians, OutputError
from keyss.core.arrays import Floats
from keyss.files.ply_rows import finite_rows, model_names, read_model_rows
from keyss.files.ply_table import ply_header

_BLOCK = 1 << 13  # Gaussians that are written at a time


def write_ply(model: Gaussians, file: BinaryIO) -> None:
    """Write `model` as little-endian float32 in the Inria layout.

    Normals are zeros, infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the
    values only. Raises OutputError when there are no Gaussians or a value is not finite.
    """
    n, k = model.sh.shape[:2]
    names = model_names(k)
    names[3:3] = ["nx", "ny", "nz"]
    flat = model.detach().to("cpu")
    file.write(ply_header({"vertex": (n, (f"float {name}" for name in names))}))
    blocks = (_rows(flat[start : start + _BLOCK]) for start in range(0, n, _BLOCK))
    for rows in finite_rows(blocks, names, OutputError):
        file.write(rows.astype("<f4", copy=False).data)


def _rows(part: Gaussians) -> Floats:
    """[N, 14 + 3 K] of some Gaussians, in the order of the file."""
    n, k = part.sh.shape[:2]
    rows = np.zeros((n, 14 + 3 * k), np.float32)
    rows[:, :3] = part.means.numpy()
    rows[:, 6:9] = part.sh[:, 0].numpy()
    rows[:, 9:-8] = part.sh[:, 1:].numpy().transpose(0, 2, 1).reshape(n, 3 * (k - 1))
    rows[:, -8] = part.opacity_logits.numpy()
    rows[:, -7:-4] = part.log_scales.numpy()
    rows[:, -4:] = part.quats.numpy()
    return rows


def read_ply(file: BinaryIO) -> Gaussians:
    """Read a 3DGS model: float32 tensors on the CPU, SH of the file's own degree.

    Properties are found by name, in any order and of any scalar type; normals, unknown properties,
    comments, other elements and bytes after the data are ignored. Infinite opacity logits become
    +-OPACITY_LOGIT_BOUND. Raises InputError if it is not a complete, finite 3DGS model.
    """
    vertices = read_model_rows(file)
    n, k = vertices.count, (len(vertices.names) - 11) // 3
    means, quats, log_scales, opacity_logits, sh = (
        np.empty((n, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (k, 3))
    )
    start = 0
    for rows in vertices.blocks:
        part = slice(start, start + len(rows))
        means[part], quats[part], log_scales[part] = rows[:, 0:3], rows[:, -4:], rows[:, -7:-4]
        opacity_logits[part], sh[part, 0] = rows[:, -8], rows[:, 3:6]
        rest = rows[:, 6:-8].reshape(len(rows), 3, -1)
        for color in range(3):
            sh[part, 1:, color] = rest[:, color]
        start = part.stop
    return Gaussians(*map(torch.from_numpy, (means, quats, log_scales, opacity_logits, sh)))
