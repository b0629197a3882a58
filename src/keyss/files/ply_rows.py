"""A 3DGS model in PLY as a table: what its properties are called, and what is wrong with their values.

Without torch, which takes a second to load, for those who only want to know what a file holds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Set
from pathlib import Path

import numpy as np

from keyss.core.errors import InputError
from keyss.files.ply_table import MAX_HEADER_BYTES, Rows, WholeTable, read_vertex_blocks
from keyss.files.streams import StandardInput

# Stands in for an infinite opacity logit. Converters write infinities for opacities of 0 and 1; a larger
# bound would not help, since the float32 sigmoid rounds to exactly 1 from 16.64 on.
OPACITY_LOGIT_BOUND = 16.0


def is_compressed(source: Path | StandardInput) -> bool:
    """Whether the header is that of a compressed model, which is read otherwise."""
    with source.open("rb") as file:
        return b" packed_position" in file.read(MAX_HEADER_BYTES).partition(b"end_header")[0]


def read_rows(path: Path | str | StandardInput) -> tuple[list[str], Rows]:
    """Names and values [N, len(names)] of a model's properties in the order of `model_names`.

    Raises InputError for anything that is not a whole, finite 3DGS model in binary or ascii PLY.
    """
    whole = WholeTable()
    return read_row_blocks(path, whole.begin), whole.rows


def read_row_blocks(
    path: Path | str | StandardInput, begin: Callable[[list[str], int], Callable[[int, Rows], None]]
) -> list[str]:
    """`read_rows` for some Gaussians at a time; `begin`: see `ply_table.read_vertex_blocks`."""
    settled = Settled()

    def begin_settled(names: list[str], count: int) -> Callable[[int, Rows], None]:
        place = begin(names, count)

        def settle_and_place(start: int, rows: Rows) -> None:
            settled.settle(rows, names)
            place(start, rows)

        return settle_and_place

    names = read_vertex_blocks(path, lambda found: _model_properties(found.keys(), path), begin_settled)
    if problem := settled.problem(names):
        raise InputError(f"{path}: {problem}")
    return names


def _model_properties(found: Set[str], path: Path | str | StandardInput) -> list[str]:
    """Names of the properties that make a model. Raises InputError if any is missing."""
    rest = {name for name in found if re.fullmatch(r"f_rest_[0-9]+", name)}
    names = model_names(len(rest) // 3 + 1)
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


class Settled:
    """What is wrong with the values of a model, which come some rows at a time."""

    def __init__(self) -> None:
        self._count, self._bad = 0, np.zeros(0, np.int64)

    def settle(self, rows: Rows, names: list[str]) -> None:
        """Clamp infinite opacity logits in place, and take notice of what is still not finite."""
        self._count += len(rows)
        if np.isfinite(rows).all():
            return
        opacity = rows[:, names.index("opacity")]
        opacity[np.isposinf(opacity)] = OPACITY_LOGIT_BOUND
        opacity[np.isneginf(opacity)] = -OPACITY_LOGIT_BOUND
        if not len(self._bad):
            self._bad = np.zeros(len(names), np.int64)
        self._bad += np.count_nonzero(~np.isfinite(rows), axis=0)

    def problem(self, names: list[str]) -> str | None:
        """What is wrong with the values, if anything."""
        if not self._count:
            return "it holds no Gaussians"
        wrong = [f"{name} in {count:,}" for name, count in zip(names, self._bad, strict=False) if count]
        if not wrong:
            return None
        more = f" and {len(wrong) - 5} more properties" if len(wrong) > 5 else ""
        return f"NaN or infinite values among {self._count:,} Gaussians: {', '.join(wrong[:5])}{more}"


def model_names(k: int) -> list[str]:
    """The layout's properties in order, without the normals, for `k` SH basis functions."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(3 * (k - 1)))]
    shape = [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return ["x", "y", "z", *colors, "opacity", *shape]
