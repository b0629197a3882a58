"""Reader and writer of 3DGS models in the Inria PLY layout.

One vertex is one Gaussian: x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3,
raw parameters as `Gaussians` holds them; f_rest is channel-major (all red coefficients, then green,
then blue).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from keyss.core import Gaussians, OutputError
from keyss.files.atomic import atomic_write
from keyss.files.ply_rows import model_names, read_rows, settle
from keyss.files.ply_table import ply_header
from keyss.files.streams import StandardInput, StandardOutput


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
    rest = flat.sh[:, 1:].transpose(1, 2).reshape(n, 3 * (k - 1))
    parts = (
        *(flat.means, torch.zeros(n, 3), flat.sh[:, 0], rest),
        *(flat.opacity_logits[:, None], flat.log_scales, flat.quats),
    )
    rows = np.concatenate(parts, axis=1, dtype="<f4")
    problem = settle(rows, names)
    if problem:
        raise OutputError(f"cannot write {path}: {problem}")
    with atomic_write(path) as file:
        file.write(ply_header({"vertex": (n, (f"float {name}" for name in names))}))
        file.write(rows.data)


def read_ply(path: Path | str | StandardInput) -> Gaussians:
    """Read a 3DGS model: float32 tensors on the CPU, SH of the file's own degree.

    Properties are found by name, in any order and of any scalar type; normals, unknown properties,
    comments, other elements and bytes after the data are ignored. Infinite opacity logits become
    +-OPACITY_LOGIT_BOUND. Raises InputError for anything that is not a whole, finite 3DGS model in
    binary or ascii PLY.
    """
    values = torch.from_numpy(read_rows(path)[1])
    rest = values[:, 6:-8].reshape(len(values), 3, -1).transpose(1, 2)  # [N, K - 1, 3]
    return Gaussians(
        means=values[:, 0:3].contiguous(),
        quats=values[:, -4:].contiguous(),
        log_scales=values[:, -7:-4].contiguous(),
        opacity_logits=values[:, -8].contiguous(),
        sh=torch.cat([values[:, None, 3:6], rest], dim=1),
    )
