"""Reader and writer of 3DGS models in the Inria PLY layout.

One vertex is one Gaussian: x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3,
raw parameters as `Gaussians` holds them; f_rest is channel-major (all red coefficients, then green,
then blue).
"""

from __future__ import annotations

import re
from collections.abc import Set
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from keyss.core import Gaussians, InputError, OutputError
from keyss.files.atomic import atomic_write
from keyss.files.ply_table import ply_header, read_vertices
from keyss.files.streams import StandardInput, StandardOutput

# Stands in for an infinite opacity logit. Converters write infinities for opacities of 0 and 1; a larger
# bound would not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0


def write_ply(path: Path | str | StandardOutput, gaussians: Gaussians) -> None:
    """Atomically write `gaussians` to `path` as little-endian float32 in the Inria layout.

    Normals are zeros, infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the
    values only. Raises OutputError when there are no Gaussians, when a value is not finite, or when the
    system refuses.
    """
    n, k = gaussians.sh.shape[:2]
    names = _model_names(k)
    names[3:3] = ["nx", "ny", "nz"]
    flat = gaussians.detach().to("cpu")
    rest = flat.sh[:, 1:].transpose(1, 2).reshape(n, 3 * (k - 1))
    parts = (
        *(flat.means, torch.zeros(n, 3), flat.sh[:, 0], rest),
        *(flat.opacity_logits[:, None], flat.log_scales, flat.quats),
    )
    rows = np.concatenate(parts, axis=1, dtype="<f4")
    problem = _settle(rows, names)
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
    names, rows = read_vertices(path, lambda found: _model_properties(found.keys(), path))
    problem = _settle(rows, names)
    if problem:
        raise InputError(f"{path}: {problem}")
    values = torch.from_numpy(rows)
    rest = values[:, 6:-8].reshape(len(values), 3, -1).transpose(1, 2)  # [N, K - 1, 3]
    return Gaussians(
        means=values[:, 0:3].contiguous(),
        quats=values[:, -4:].contiguous(),
        log_scales=values[:, -7:-4].contiguous(),
        opacity_logits=values[:, -8].contiguous(),
        sh=torch.cat([values[:, None, 3:6], rest], dim=1),
    )


def _model_properties(found: Set[str], path: Path | str | StandardInput) -> list[str]:
    """Names of the properties that make a model. Raises InputError if any is missing."""
    rest = {name for name in found if re.fullmatch(r"f_rest_[0-9]+", name)}
    names = _model_names(len(rest) // 3 + 1)
    if len(rest) not in (0, 9, 24, 45) or not rest <= set(names):
        raise InputError(
            f"{path}: expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ... (SH degree 0 to 3), "
            f"got {len(rest)}"
        )
    missing = [name for name in names if name not in found]
    if not missing:
        return names
    if "packed_position" in found:
        why = "this is a compressed .ply, which `read_model` reads"
    elif missing == names[3:]:
        why = "this is a point cloud, not a 3DGS model"
    else:
        why = "this is not a 3DGS model"
    raise InputError(f"{path}: {why}: properties missing: {', '.join(missing)}")


def _settle(rows: npt.NDArray[np.float32], names: list[str]) -> str | None:
    """Clamp infinite opacity logits in place; say what is still wrong with the values, if anything."""
    if len(rows) == 0:
        return "it holds no Gaussians"
    opacity = rows[:, names.index("opacity")]
    opacity[np.isposinf(opacity)] = OPACITY_LOGIT_BOUND
    opacity[np.isneginf(opacity)] = -OPACITY_LOGIT_BOUND
    bad = np.count_nonzero(~np.isfinite(rows), axis=0)
    wrong = [f"{name} in {count:,}" for name, count in zip(names, bad, strict=True) if count]
    if not wrong:
        return None
    more = f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else ""
    return f"NaN or infinite values among {len(rows):,} Gaussians: {', '.join(wrong[:5])}{more}"


def _model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]
