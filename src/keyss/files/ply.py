"""Reader and writer of 3DGS models in the Inria PLY layout.

One vertex is one Gaussian: x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3,
raw parameters as `Gaussians` holds them; f_rest is channel-major (all red coefficients, then green,
then blue).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from keyss.core import Gaussians, OutputError
from keyss.files.atomic import atomic_write
from keyss.files.ply_rows import Settled, model_names, read_row_blocks
from keyss.files.ply_table import Rows, ply_header
from keyss.files.streams import StandardInput, StandardOutput

_BLOCK = 1 << 13  # Gaussians that are written at a time


def write_ply(path: Path | str | StandardOutput, gaussians: Gaussians) -> None:
    """Atomically write `gaussians` to `path` as little-endian float32 in the Inria layout.

    Normals are zeros, infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the
    values only. Raises OutputError when there are no Gaussians, when a value is not finite, or when the
    system refuses.
    """
    n, k = gaussians.sh.shape[:2]
    names = model_names(k)
    names[3:3] = ["nx", "ny", "nz"]
    flat = gaussians.detach().to("cpu")
    settled = Settled()
    with atomic_write(path) as file:
        file.write(ply_header({"vertex": (n, (f"float {name}" for name in names))}))
        for start in range(0, n, _BLOCK):
            rows = _rows(flat[start : start + _BLOCK])
            settled.settle(rows, names)
            file.write(rows.astype("<f4", copy=False).data)
        if problem := settled.problem(names):
            raise OutputError(f"cannot write {path}: {problem}")


def _rows(part: Gaussians) -> npt.NDArray[np.float32]:
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


def read_ply(path: Path | str | StandardInput) -> Gaussians:
    """Read a 3DGS model: float32 tensors on the CPU, SH of the file's own degree.

    Properties are found by name, in any order and of any scalar type; normals, unknown properties,
    comments, other elements and bytes after the data are ignored. Infinite opacity logits become
    +-OPACITY_LOGIT_BOUND. Raises InputError for anything that is not a whole, finite 3DGS model in
    binary or ascii PLY.
    """
    tensors: list[npt.NDArray[np.float32]] = []

    def begin(names: list[str], count: int) -> Callable[[int, Rows], None]:
        k = (len(names) - 11) // 3
        for shape in ((3,), (4,), (3,), (), (k, 3)):
            tensors.append(np.empty((count, *shape), np.float32))
        return place

    def place(start: int, rows: Rows) -> None:
        part = slice(start, start + len(rows))
        means, quats, log_scales, opacity_logits, sh = tensors
        means[part], quats[part], log_scales[part] = rows[:, 0:3], rows[:, -4:], rows[:, -7:-4]
        opacity_logits[part], sh[part, 0] = rows[:, -8], rows[:, 3:6]
        rest = rows[:, 6:-8].reshape(len(rows), 3, -1)
        for colour in range(3):
            sh[part, 1:, colour] = rest[:, colour]

    read_row_blocks(path, begin)
    return Gaussians(*map(torch.from_numpy, tensors))
