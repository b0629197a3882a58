"""The PLY layout of Inria's 3DGS: one vertex per Gaussian, raw parameters as `Gaussians` holds them.

x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3; f_rest is channel-major (all red
coefficients, then green, then blue).
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
import torch

from keyss.core.arrays import Floats
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import writable
from keyss.files.ply_extras import NORMALS, ExtendedGaussians, PlyExtras, names_with_normals
from keyss.files.ply_rows import check_not_activated, model_names, read_rows
from keyss.files.ply_table import TYPES, ply_header

_BLOCK = 1 << 13  # Gaussians written at a time


def read(file: BinaryIO) -> Gaussians:
    """The model in an open file: float32 tensors on the CPU, SH of the file's own degree.

    Properties may have any order and any scalar type; all others are ignored. See `read_rows` for values that
    are not finite. Raises InputError if it is not a complete 3DGS model.
    """
    model = read_rows(file)
    n, k = model.count, (len(model.names) - 11) // 3
    means, quats, log_scales, opacity_logits, sh = (
        np.empty((n, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (k, 3))
    )
    start = 0
    for rows, _ in model.blocks:
        part = slice(start, start + len(rows))
        means[part], quats[part], log_scales[part] = rows[:, 0:3], rows[:, -4:], rows[:, -7:-4]
        opacity_logits[part], sh[part, 0] = rows[:, -8], rows[:, 3:6]
        rest = rows[:, 6:-8].reshape(len(rows), 3, k - 1)
        for color in range(3):
            sh[part, 1:, color] = rest[:, color]
        start = part.stop
    check_not_activated(means[:start], log_scales[:start], opacity_logits[:start])
    arrays = (means, quats, log_scales, opacity_logits, sh)
    return Gaussians(*(torch.from_numpy(each[:start]) for each in arrays))


def holds(file: BinaryIO, model: Gaussians) -> bool:
    """True if `read` gives `model`, to the bit; takes no memory for a second model. Raises InputError."""
    flat, start = model.detach().to("cpu"), 0
    for rows, _ in read_rows(file).blocks:
        own = np.delete(_rows(flat[start : start + len(rows)]), slice(3, 6), axis=1)  # normals
        if own.shape != rows.shape or (own.view(np.uint32) != rows.view(np.uint32)).any():
            return False
        start += len(rows)
    check_not_activated(*(each.numpy() for each in (flat.means, flat.log_scales, flat.opacity_logits)))
    return start == len(flat)


def write(model: Gaussians, file: BinaryIO) -> None:
    """Write a model as little-endian float32.

    Normals are zeros, in Inria's order, and there are no other properties, unless `model` has extras.
    Infinite opacity logits become +-OPACITY_LOGIT_BOUND, and the bytes depend on the values only. Raises
    OutputError if there are no Gaussians or a value is not finite.
    """
    extras = model.extras if isinstance(model, ExtendedGaussians) else PlyExtras()
    flat = writable(model)
    n, needed = len(flat), model_names(flat.sh.shape[1])
    names = names_with_normals(needed)
    further = {name: values for name, values in extras.properties.items() if name not in NORMALS}
    types = dict.fromkeys(names, "f4") | {name: each.dtype.str[1:] for name, each in further.items()}
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
            own = extras.properties.get(name)
            table[name] = rows[:, names.index(name)] if own is None else own[part]
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
