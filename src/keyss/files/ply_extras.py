"""Properties, comments and the order of properties in a 3DGS .ply of another program."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
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
    """Comments, the order of all properties, and values [N] of further ones, in the types of the file."""

    comments: tuple[str, ...] = ()  # whole lines
    order: tuple[str, ...] = ()  # names; empty: that of Inria's layout
    properties: Mapping[str, Numbers] = field(default_factory=dict)  # by name


class ExtendedGaussians(Gaussians):
    """A model to be written as a .ply with `extras`. Derived models are plain `Gaussians`."""

    __slots__ = ("extras",)  # not in vars(), which holds the tensors

    extras: PlyExtras


def with_extras(model: Gaussians, source: Any, read: Gaussians) -> Gaussians:
    """`model` with the extras of the .ply at `source`, from which `read` was read; `model` if there are none.

    Further properties stay only if it is the Gaussians of `read` in their order, possibly with more Gaussians
    appended, whose properties are 0. Raises InputError.
    """
    if type(model) is not Gaussians or not isinstance(source, str | Path):
        return model
    path, more = model_file(source), len(model) - len(read)
    extras = _read_extras(path, len(read)) if path.is_file() else None
    if extras is None:
        return model
    kept = extras.properties if _has_rows_of(model, read) else {}
    extended = ExtendedGaussians(*(getattr(model, each.name) for each in fields(Gaussians)))
    padded = {name: np.pad(values, (0, more)) for name, values in kept.items()}
    object.__setattr__(extended, "extras", replace(extras, properties=padded))
    return extended


def _has_rows_of(model: Gaussians, read: Gaussians) -> bool:
    """True if a model begins with the Gaussians of `read`, in their order."""
    if len(model) < len(read):
        return False
    moved = (model.means[: len(read)].cpu() - read.means.cpu()).abs()
    return bool((moved <= _MAX_MOVED * read.means.cpu().std(0, correction=0) + 1e-30).all())


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
    order = model.dtype.names or ()
    if not (values or model.comments) and list(order) == names_with_normals(model.names):
        return None
    return PlyExtras(tuple(model.comments), order, values)


def names_with_normals(names: Sequence[str]) -> list[str]:
    """All properties of Inria's layout, from those that make a model."""
    return [*names[:3], *NORMALS, *names[3:]]
