"""A 3DGS model in PLY as a table: the names of its properties, and checks of their values.

Does not import torch, which takes a second, so that `keyss info` is fast.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Flags, Floats, Integers
from keyss.core.errors import InputError, KeyssWarning, OutputError
from keyss.files.ply_table import MAX_HEADER_BYTES, Vertices, read_vertices
from keyss.files.reading import open_input

# Replaces an infinite opacity logit, which converters write for opacities of 0 and 1. A larger bound would
# not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0
LEAST_LOG_SCALE = -87.33654  # of the smallest normal float32; in place of minus infinity
_ENOUGH = 100  # Gaussians from which on `check_not_activated` judges, and about as many that it looks at
_NEARLY_ALL = 0.99  # share of the scales
# Values that are all positive are scales, not their logarithms, if half of them are below _SMALL_SCALE, if as
# logarithms they made half of the Gaussians larger than _LARGE of the model, or if they vary by _RATIO.
_SMALL_SCALE, _LARGE, _RATIO = 0.2, 0.3, 20.0


def is_compressed(path: Path) -> bool:
    """True if a .ply is a compressed model. Raises OSError."""
    with path.open("rb") as file:
        return has_packed_header(file)


def has_packed_header(file: BinaryIO) -> bool:
    """True if a .ply that is open at its start is a compressed model; the position stays."""
    header = file.read(MAX_HEADER_BYTES).partition(b"end_header")[0]
    file.seek(0)
    return b" packed_position" in header


def read_rows(path: Path) -> tuple[list[str], Floats]:
    """Names and values [N, len(names)] of a model's properties in the order of `model_names`.

    Rows as of `usable_rows`. Raises InputError if it is not a complete 3DGS model in binary or ascii PLY.
    """
    with open_input(path) as file:
        vertices = read_model_rows(file)
        return vertices.names, vertices.rows()


def read_model_rows(file: BinaryIO) -> Vertices:
    """The properties of a model in the order of `model_names`, as `usable_rows`. Raises InputError."""
    vertices = read_vertices(file, model_properties)
    return replace(vertices, blocks=usable_rows(vertices, getattr(file, "name", "the model")))


def usable_rows(vertices: Vertices, where: str) -> Iterator[Floats]:
    """The blocks of a model without rows that renderers cannot draw, of whose number a KeyssWarning tells.

    Infinite opacity logits become +-OPACITY_LOGIT_BOUND, and log scales of minus infinity (flat Gaussians)
    LEAST_LOG_SCALE. Raises InputError if no rows remain.
    """
    names = vertices.names
    kept, bad = 0, np.zeros(len(names), np.int64)
    scales = slice(names.index("scale_0"), names.index("scale_0") + 3)
    for rows in vertices.blocks:
        if not np.isfinite(rows).all():
            _clamp_opacities(rows, names)
            log_scales = rows[:, scales]
            log_scales[np.isneginf(log_scales)] = LEAST_LOG_SCALE
            finite = np.isfinite(rows)
            bad += np.count_nonzero(~finite, axis=0)
            rows = rows[finite.all(axis=1)]
        if len(rows):
            kept += len(rows)
            yield rows
    if not vertices.count:
        raise InputError("it holds no Gaussians")
    if not kept:
        raise InputError(_not_finite(vertices.count, names, bad))
    if kept < vertices.count:
        warnings.warn(
            f"{where}: {vertices.count - kept:,} of {vertices.count:,} Gaussians are left out: they have NaN "
            f"or infinite values ({_counts(names, bad)})",
            KeyssWarning,
            stacklevel=2,
        )


def finite_gaussians(table: npt.NDArray[np.void]) -> Flags:
    """[N] the vertices that `usable_rows` keeps, of all in a file."""
    names = model_properties(table.dtype.names or ())
    finite = np.ones(len(table), np.bool_)
    for name in names:
        with np.errstate(over="ignore"):
            values = table[name].astype(np.float32)
        flat, opacity = name.startswith("scale_") & np.isneginf(values), name == "opacity"
        finite &= np.isfinite(values) | flat | (opacity & ~np.isnan(values))
    return finite


def finite_rows(blocks: Iterable[Floats], names: list[str]) -> Iterator[Floats]:
    """The blocks with infinite opacity logits clamped in place to +-OPACITY_LOGIT_BOUND, to be written.

    At the end raises OutputError if there were no rows or if other values were not finite.
    """
    count, bad = 0, np.zeros(len(names), np.int64)
    for rows in blocks:
        count += len(rows)
        if not np.isfinite(rows).all():
            _clamp_opacities(rows, names)
            bad += np.count_nonzero(~np.isfinite(rows), axis=0)
        yield rows
    if not count:
        raise OutputError("it holds no Gaussians")
    if bad.any():
        raise OutputError(_not_finite(count, names, bad))


def _clamp_opacities(rows: Floats, names: list[str]) -> None:
    logits = rows[:, names.index("opacity")]
    logits[np.isposinf(logits)] = OPACITY_LOGIT_BOUND
    logits[np.isneginf(logits)] = -OPACITY_LOGIT_BOUND


def _not_finite(count: int, names: list[str], bad: Integers) -> str:
    return f"NaN or infinite values among {count:,} Gaussians: {_counts(names, bad)}"


def _counts(names: list[str], bad: Integers) -> str:
    """How many values of each property are not finite."""
    wrong = [f"{name} in {number:,}" for name, number in zip(names, bad, strict=True) if number]
    more = f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else ""
    return ", ".join(wrong[:5]) + more


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
        kind = "a point cloud, not a 3DGS model" if missing == names[3:] else "not a 3DGS model"
        raise InputError(f"this is {kind}: properties missing: {', '.join(missing)}")
    return names


def model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]
