"""Properties and comments that other programs add to a 3DGS .ply."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from keyss.core.arrays import Numbers
from keyss.core.errors import InputError, KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.files.inputs import open_input
from keyss.files.ply_rows import has_packed_header, read_rows
from keyss.files.training_outputs import model_file

NORMALS = ("nx", "ny", "nz")
_MAX_MOVED = 0.01  # distance by which hiding moves Gaussians, relative to the model's standard deviation


@dataclass(frozen=True, eq=False)
class PlyExtras:
    """Comments, and values [N] of further properties by name, in the order and types of the file."""

    comments: tuple[str, ...]  # whole lines
    properties: Mapping[str, Numbers]


class ExtendedGaussians(Gaussians):
    """A model to be written as a .ply with `extras`. Derived models are plain `Gaussians`."""

    __slots__ = ("extras",)  # not in vars(), which holds the tensors

    extras: PlyExtras


def with_extras(model: Gaussians, source: Any, read: Gaussians) -> Gaussians:
    """`model` with the extras of the .ply at `source`, from which `read` was read.

    Returns `model` if there are none, or if it is not the Gaussians of `read` in their order, possibly with
    more Gaussians appended, whose extras are 0. Raises InputError.
    """
    if type(model) is not Gaussians or not isinstance(source, str | Path):
        return model
    path, more = model_file(source), len(model) - len(read)
    extras = _read_extras(path, len(read)) if path.is_file() else None
    if extras is None or more < 0:
        return model
    moved = (model.means[: len(read)].cpu() - read.means.cpu()).abs()
    if not bool((moved <= _MAX_MOVED * read.means.cpu().std(0, correction=0) + 1e-30).all()):
        return model
    extended = ExtendedGaussians(*(getattr(model, each.name) for each in fields(Gaussians)))
    padded = {name: np.pad(values, (0, more)) for name, values in extras.properties.items()}
    object.__setattr__(extended, "extras", PlyExtras(extras.comments, padded))
    return extended


def _read_extras(path: Path, count: int) -> PlyExtras | None:
    """The extras of a .ply of which `count` Gaussians were read; None if there are none."""
    with open_input(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # about Gaussians left out, which the first read gave
        if file.read(3) != b"ply":
            return None
        file.seek(0)
        if has_packed_header(file):
            return None
        model = read_rows(file)
        names = [name for name in model.dtype.names or () if name not in model.names]
        blocks = [{name: table[name].copy() for name in names} for _, table in model.blocks]
    values = {name: np.concatenate([block[name] for block in blocks]) for name in names}
    values = {name: each for name, each in values.items() if name not in NORMALS or each.any()}
    if any(len(each) != count for each in values.values()):
        raise InputError(f"{path}: it changed while it was read")
    return PlyExtras(tuple(model.comments), values) if values or model.comments else None
