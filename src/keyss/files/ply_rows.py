"""A 3DGS model in PLY as a table: the names of its properties, and checks of their values.

Does not import torch, which takes a second, so that `keyss info` is fast.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from keyss.core.arrays import Floats
from keyss.core.errors import InputError, KeyssError
from keyss.files.ply_table import MAX_HEADER_BYTES, Vertices, read_vertices
from keyss.files.reading import open_input

# Replaces an infinite opacity logit, which converters write for opacities of 0 and 1. A larger bound would
# not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0


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

    Raises InputError if it is not a complete, finite 3DGS model in binary or ascii PLY.
    """
    with open_input(path) as file:
        vertices = read_model_rows(file)
        return vertices.names, vertices.rows()


def read_model_rows(file: BinaryIO) -> Vertices:
    """The properties of a model in the order of `model_names`, as `finite_rows`. Raises InputError."""
    vertices = read_vertices(file, _model_properties)
    return replace(vertices, blocks=finite_rows(vertices.blocks, vertices.names, InputError))


def finite_rows(blocks: Iterable[Floats], names: list[str], error: type[KeyssError]) -> Iterator[Floats]:
    """The blocks with infinite opacity logits clamped in place to +-OPACITY_LOGIT_BOUND.

    At the end raises `error` if there were no rows or if other values were not finite.
    """
    count, bad = 0, np.zeros(len(names), np.int64)
    opacity = names.index("opacity")
    for rows in blocks:
        count += len(rows)
        if not np.isfinite(rows).all():
            logits = rows[:, opacity]
            logits[np.isposinf(logits)] = OPACITY_LOGIT_BOUND
            logits[np.isneginf(logits)] = -OPACITY_LOGIT_BOUND
            bad += np.count_nonzero(~np.isfinite(rows), axis=0)
        yield rows
    if not count:
        raise error("it holds no Gaussians")
    if bad.any():
        wrong = [f"{name} in {number:,}" for name, number in zip(names, bad, strict=True) if number]
        more = f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else ""
        raise error(f"NaN or infinite values among {count:,} Gaussians: {', '.join(wrong[:5])}{more}")


def _model_properties(found: Mapping[str, str]) -> list[str]:
    """Names of the properties that make a model. Raises InputError if any is missing."""
    rest = {name for name in found if re.fullmatch(r"f_rest_[0-9]+", name)}
    names = model_names(len(rest) // 3 + 1)
    if len(rest) not in (0, 9, 24, 45) or not rest <= set(names):
        raise InputError(
            f"expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ... (SH degree 0 to 3), got {len(rest)}"
        )
    missing = [name for name in names if name not in found]
    if missing:
        kind = "a point cloud, not a 3DGS model" if missing == names[3:] else "not a 3DGS model"
        raise InputError(f"this is {kind}: properties missing: {', '.join(missing)}")
    return names


def model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]
