"""What other programs put into a 3DGS .ply: properties that are not part of a model, and comments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from keyss.core.arrays import Numbers
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.files.ply_rows import finite_gaussians, has_packed_header, model_properties
from keyss.files.ply_table import read_vertex_table
from keyss.files.reading import open_input
from keyss.files.trained import model_file

NORMALS = ("nx", "ny", "nz")
_SAME_PLACE = 0.01  # of the model's spread: how far hiding moves no Gaussian


@dataclass(frozen=True, eq=False)
class PlyExtras:
    """Comments, and values [N] of further properties by name, in the order and types of the file."""

    comments: tuple[str, ...]  # whole lines
    properties: Mapping[str, Numbers]


class ExtendedGaussians(Gaussians):
    """A model to be written as a .ply with `extras`. Derived models are plain `Gaussians`."""

    __slots__ = ("extras",)  # not in vars(), which holds the tensors

    extras: PlyExtras

    @staticmethod
    def of(model: Gaussians, extras: PlyExtras) -> ExtendedGaussians:
        found = ExtendedGaussians(*(getattr(model, each.name) for each in fields(Gaussians)))
        object.__setattr__(found, "extras", extras)
        return found


def with_extras(model: Gaussians, source: Any, read: Gaussians) -> Gaussians:
    """`model` with the extras of the .ply at `source`, from which `read` was read, if there are any.

    `model` has the Gaussians of `read` in the same order, and possibly more after them, whose extras are 0.
    Otherwise, and for a source that is not the path of a .ply, the result is `model`. Raises InputError.
    """
    if type(model) is not Gaussians or not isinstance(source, str | Path):
        return model
    path = model_file(source)
    extras = _read_extras(path, len(read)) if path.is_file() else None
    if extras is None or not _begins_with(model, read):
        return model
    missing = len(model) - len(read)
    padded = {name: np.pad(values, (0, missing)) for name, values in extras.properties.items()}
    return ExtendedGaussians.of(model, PlyExtras(extras.comments, padded))


def _begins_with(model: Gaussians, read: Gaussians) -> bool:
    if len(model) < len(read):
        return False
    moved = (model.means[: len(read)].cpu() - read.means.cpu()).abs()
    return bool((moved <= _SAME_PLACE * read.means.cpu().std(0, correction=0) + 1e-30).all())


def _read_extras(path: Path, count: int) -> PlyExtras | None:
    """The extras of a .ply of which `count` Gaussians were read; None without any."""
    with open_input(path) as file:
        if file.read(3) != b"ply":
            return None
        file.seek(0)
        if has_packed_header(file):
            return None
        table = read_vertex_table(file)
        names = [name for name in table.names if name not in model_properties(table.names)]
        if table.count < count:
            raise InputError("it changed while it was read")
        parts: dict[str, list[Numbers]] = {name: [] for name in names}
        for block in table.blocks:
            rows = block[finite_gaussians(block)] if table.count > count else block
            for name, values in parts.items():
                values.append(rows[name].copy())
    every = {name: np.concatenate(values) for name, values in parts.items()}
    kept = {name: values for name, values in every.items() if name not in NORMALS or values.any()}
    return PlyExtras(tuple(table.comments), kept) if kept or table.comments else None
