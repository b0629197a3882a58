"""3DGS models in PLY files as NumPy arrays: names of properties, and checks of values.

Does not import torch, which takes a second, so that `keyss info` is fast.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from keyss.core.arrays import Floats
from keyss.core.errors import InputError, KeyssWarning
from keyss.files.ply_table import MAX_HEADER_BYTES, Table, Vertices, columns, read_vertices

# Replaces an infinite opacity logit, which converters write for opacities of 0 and 1. A larger bound would
# not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0
LEAST_LOG_SCALE = -87.33654  # of the smallest normal float32; in place of minus infinity
_ENOUGH = 100  # Gaussians from which on `check_not_activated` judges, and about as many that it looks at
_NEARLY_ALL = 0.99  # share of the scales
# Values that are all positive are scales, not their logarithms, if half of them are below _SMALL_SCALE, if as
# logarithms they made half of the Gaussians larger than _LARGE of the model, or if they vary by _RATIO.
_SMALL_SCALE, _LARGE, _RATIO = 0.2, 0.3, 20.0


def has_packed_header(file: BinaryIO) -> bool:
    """True if a PLY file is a compressed model. The position stays at the start."""
    header = file.read(MAX_HEADER_BYTES).partition(b"end_header")[0]
    file.seek(0)
    return b" packed_position" in header


@dataclass
class ModelRows:
    """The Gaussians of an open PLY file, a block of rows at a time, without those that cannot be drawn."""

    names: list[str]  # `model_names`
    count: int  # Gaussians in the file
    comments: list[str]
    dtype: np.dtype[np.void]  # of all properties in the file
    blocks: Iterator[tuple[Floats, Table]]  # values of `names` [n, len(names)], and all properties [n]


def read_rows(file: BinaryIO) -> ModelRows:
    """The model in a PLY file that is open at its start.

    Clamps infinite opacity logits to +-OPACITY_LOGIT_BOUND and log scales of minus infinity (flat Gaussians)
    to LEAST_LOG_SCALE. Leaves out other Gaussians with NaN or infinite values, with a KeyssWarning at the
    end. Raises InputError if it is not a complete 3DGS model, or if no Gaussians remain.
    """
    vertices = read_vertices(file)
    names = model_properties(vertices.dtype.names or ())
    blocks = _finite_blocks(vertices, names, getattr(file, "name", "the model"))
    return ModelRows(names, vertices.count, vertices.comments, vertices.dtype, blocks)


def _finite_blocks(vertices: Vertices, names: list[str], where: str) -> Iterator[tuple[Floats, Table]]:
    kept, bad = 0, np.zeros(len(names), np.int64)
    for table in vertices.blocks:
        rows = columns(table, names)
        if not np.isfinite(rows).all():
            logits, log_scales = rows[:, -8], rows[:, -7:-4]
            logits[np.isposinf(logits)] = OPACITY_LOGIT_BOUND
            logits[np.isneginf(logits)] = -OPACITY_LOGIT_BOUND
            log_scales[np.isneginf(log_scales)] = LEAST_LOG_SCALE
            finite = np.isfinite(rows)
            bad += np.count_nonzero(~finite, axis=0)
            rows, table = rows[finite.all(axis=1)], table[finite.all(axis=1)]
        kept += len(rows)
        yield rows, table
    if not vertices.count:
        raise InputError("it holds no Gaussians")
    wrong = [f"{name} in {number:,}" for name, number in zip(names, bad, strict=True) if number]
    said = ", ".join(wrong[:5]) + (f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else "")
    if not kept:
        raise InputError(f"NaN or infinite values among {vertices.count:,} Gaussians: {said}")
    if kept < vertices.count:
        warnings.warn(
            f"{where}: {vertices.count - kept:,} of {vertices.count:,} Gaussians are left out: they have NaN "
            f"or infinite values ({said})",
            KeyssWarning,
            stacklevel=2,
        )


def check_not_activated(means: Floats, log_scales: Floats, opacity_logits: Floats) -> None:
    """Raise InputError if scales or opacities of a model [N, ...] are those that renderers use.

    Logits of trained models are not all within 0 to 1. Logarithms of scales are all positive in large units
    only, where they are much alike.
    """
    if len(means) < _ENOUGH:
        return
    means, log_scales = means[:: len(means) // _ENOUGH], log_scales[:: len(means) // _ENOUGH]
    spread = np.median(np.abs(means - np.median(means, axis=0)).max(axis=1))
    least, middle, most = np.quantile(log_scales, [0.05, 0.5, 0.95])
    large = middle < _SMALL_SCALE or np.exp(min(middle, 80.0)) > _LARGE * spread or most > _RATIO * least
    low, high = opacity_logits.min(), opacity_logits.max()
    activated = {
        "scales": bool((log_scales > 0).mean() > _NEARLY_ALL) and large,
        "opacities": low >= 0 and high <= 1 and high - low > 0.5,
    }
    wrong = [name for name, each in activated.items() if each]
    if wrong:
        raise InputError(
            f"its {' and '.join(wrong)} are those that renderers use, where a 3DGS .ply has logarithms of "
            "scales and logits of opacities: export it again without activating them, or apply log to "
            "scale_0, scale_1 and scale_2 and logit to opacity"
        )


def model_properties(found: Collection[str]) -> list[str]:
    """Names of the properties that make a model. Raises InputError if any is missing."""
    rest = {name for name in found if re.fullmatch(r"f_rest_[0-9]+", name)}
    names = model_names(len(rest) // 3 + 1)
    if len(rest) not in (0, 9, 24, 45) or not rest <= set(names):
        raise InputError(
            f"expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., got {len(rest)}: export it again "
            "with harmonics of degree 0, 1, 2 or 3"
        )
    missing = [name for name in names if name not in found]
    if missing == ["scale_2"]:
        raise InputError(
            "this is a 2DGS model: its Gaussians are flat and have no scale_2; open it in SuperSplat "
            "(superspl.at/editor) and export a .ply, which has one"
        )
    if missing[:3] == names[3:6] and {"red", "green", "blue", "opacity"} <= set(found):
        raise InputError(
            "this is a 3DGS model with colours as red, green and blue instead of harmonics (f_dc_0, ...): "
            "export it again with harmonics, from Nerfstudio with "
            "`ns-export gaussian-splat --ply-color-mode sh_coeffs`"
        )
    if missing:
        kind = "a mesh or point cloud, not a 3DGS model" if missing == names[3:] else "not a 3DGS model"
        raise InputError(f"this is {kind}: properties missing: {', '.join(missing)}")
    return names


def model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]
