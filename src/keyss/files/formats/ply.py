"""The PLY layout of Inria's 3DGS: one vertex per Gaussian, raw parameters as `Gaussians` holds them.

x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3; f_rest is channel-major (all red
coefficients, then green, then blue). A .ply of another program may have further properties and comments.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from keyss.core.arrays import Floats, Numbers
from keyss.core.errors import InputError, KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.files.file_kinds import model_file
from keyss.files.formats.common import writable
from keyss.files.inputs import open_input
from keyss.files.ply_table import TYPES, check_not_activated, is_plain, model_names, ply_header, read_rows

_BLOCK = 1 << 13  # Gaussians written at a time
_NORMALS = ("nx", "ny", "nz")
_MAX_MOVED = 0.01  # distance by which hiding moves Gaussians, relative to the model's standard deviation


@dataclass(frozen=True, eq=False)
class _Extras:
    """Comments, the order of all properties, and values [N] of further ones, in the types of the file."""

    comments: tuple[str, ...] = ()  # whole lines
    order: tuple[str, ...] = ()  # names; empty: that of Inria's layout
    properties: Mapping[str, Numbers] = field(default_factory=dict)  # by name


class _ExtendedGaussians(Gaussians):
    """A model to be written as a .ply with `extras`. Derived models are plain `Gaussians`."""

    __slots__ = ("extras",)  # not in vars(), which holds the tensors

    extras: _Extras


def read(file: BinaryIO) -> Gaussians:
    """The model in an open file: float32 tensors on the CPU, SH of the file's own degree.

    Properties may have any order and any scalar type; all others are ignored. See `read_rows` for values that
    are not finite. Raises InputError if it is not a complete 3DGS model.
    """
    vertices, names, blocks = read_rows(file)
    n, k = vertices.count, (len(names) - 11) // 3
    means, quats, log_scales, opacity_logits, sh = (
        np.empty((n, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (k, 3))
    )
    start = 0
    for rows, _ in blocks:
        part = slice(start, start + len(rows))
        means[part], quats[part], log_scales[part] = rows[:, 0:3], rows[:, -4:], rows[:, -7:-4]
        opacity_logits[part], sh[part, 0] = rows[:, -8], rows[:, 3:6]
        sh[part, 1:] = rows[:, 6:-8].reshape(len(rows), 3, k - 1).transpose(0, 2, 1)
        start = part.stop
    check_not_activated(means[:start], log_scales[:start], opacity_logits[:start])
    arrays = (means, quats, log_scales, opacity_logits, sh)
    return Gaussians(*(torch.from_numpy(array[:start]) for array in arrays))


def holds(file: BinaryIO, model: Gaussians) -> bool:
    """True if `read` gives `model`, to the bit; takes no memory for a second model. Raises InputError."""
    flat, start = model.detach().to("cpu"), 0
    for rows, _ in read_rows(file)[2]:
        values = np.delete(_rows(flat[start : start + len(rows)]), slice(3, 6), axis=1)  # normals
        if values.shape != rows.shape or (values.view(np.uint32) != rows.view(np.uint32)).any():
            return False
        start += len(rows)
    check_not_activated(*(tensor.numpy() for tensor in (flat.means, flat.log_scales, flat.opacity_logits)))
    return start == len(flat)


def write(model: Gaussians, file: BinaryIO) -> None:
    """Write a model as little-endian float32.

    Normals are zeros, in Inria's order, and there are no other properties, unless `model` has extras.
    Infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the values only. Raises
    OutputError if there are no Gaussians or a value is not finite.
    """
    extras = model.extras if isinstance(model, _ExtendedGaussians) else _Extras()
    flat = writable(model)
    n, needed = len(flat), model_names(flat.sh.shape[1])
    names = [*needed[:3], *_NORMALS, *needed[3:]]
    further = {name: values for name, values in extras.properties.items() if name not in _NORMALS}
    types = dict.fromkeys(names, "f4") | {name: column.dtype.str[1:] for name, column in further.items()}
    order = [name for name in extras.order if name in types]
    if not set(needed) <= set(order):
        order = list(types)
    properties = [f"{TYPES[types[name]]} {name}" for name in order]
    file.write(ply_header({"vertex": (n, properties)}, extras.comments))
    dtype = np.dtype([(name, f"<{types[name]}") for name in order])
    for start in range(0, n, _BLOCK):
        part = slice(start, start + _BLOCK)
        rows = _rows(flat[part])
        if order == names and not extras.properties:  # faster
            file.write(rows.astype("<f4", copy=False).data)
            continue
        table = np.empty(len(rows), dtype)
        for name in order:
            column = extras.properties.get(name)
            table[name] = rows[:, names.index(name)] if column is None else column[part]
        file.write(table.data)


def _rows(part: Gaussians) -> Floats:
    """[N, 14 + 3 K] values in the order of the file."""
    n, k = part.sh.shape[:2]
    rows = np.zeros((n, 14 + 3 * k), np.float32)
    rows[:, :3] = part.means.numpy()
    rows[:, 6:9] = part.sh[:, 0].numpy()
    rows[:, 9:-8] = part.sh[:, 1:].numpy().transpose(0, 2, 1).reshape(n, 3 * (k - 1))
    rows[:, -8] = part.opacity_logits.numpy()
    rows[:, -7:-4] = part.log_scales.numpy()
    rows[:, -4:] = part.quats.numpy()
    return rows


def with_extras(model: Gaussians, source: Any, read: Gaussians) -> Gaussians:
    """`model` with the extras of the .ply at `source`, from which `read` was read.

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
    extended = _ExtendedGaussians(*(getattr(model, field.name) for field in fields(Gaussians)))
    padded = {name: np.pad(values, (0, more)) for name, values in kept.items()}
    object.__setattr__(extended, "extras", replace(extras, properties=padded))
    return extended


def _has_rows_of(model: Gaussians, read: Gaussians) -> bool:
    """True if a model begins with the Gaussians of `read`, in their order."""
    if len(model) < len(read):
        return False
    moved = (model.means[: len(read)].cpu() - read.means.cpu()).abs()
    return bool((moved <= _MAX_MOVED * read.means.cpu().std(0, correction=0) + 1e-30).all())


def _read_extras(path: Path, count: int) -> _Extras | None:
    """The extras of a .ply, None for a compressed one. `count`: its Gaussians in the first read."""
    with open_input(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # about Gaussians left out, which the first read gave
        if not is_plain(file):
            return None
        vertices, needed, rows = read_rows(file)
        order = vertices.dtype.names or ()
        names = [name for name in order if name not in needed]
        blocks = [{name: table[name].copy() for name in names} for _, table in rows]
    values = {name: np.concatenate([block[name] for block in blocks]) for name in names}
    values = {name: column for name, column in values.items() if name not in _NORMALS or column.any()}
    if any(len(column) != count for column in values.values()):
        raise InputError(f"{path}: it changed while it was read")
    return _Extras(tuple(vertices.comments), order, values)
