"""What a 3DGS .ply holds, without the model in memory and without torch, whose import takes a second."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from keyss.core.arrays import Floats
from keyss.files.inputs import open_input
from keyss.files.ply_table import SAMPLE, check_not_activated, is_plain, read_rows

NEARLY_TRANSPARENT = math.log(0.05 / 0.95)  # opacity logit


@dataclass(frozen=True)
class PlySummary:
    """The size of a model, and statistics of its Gaussians."""

    gaussians: int
    sh_degree: int
    low: Floats  # [3] corner of the bounding box, like `high`
    high: Floats
    nearly_transparent: int  # Gaussians with opacities below 0.05


def summarise_ply(path: Path) -> PlySummary | None:
    """The summary of a .ply, None for any other file; raises as `read_model` does."""
    if not path.is_file() or not path.name.lower().endswith(".ply"):
        return None
    with open_input(path) as file:
        if file.read(3) != b"ply":
            return None
        file.seek(0)
        return _summary(file) if is_plain(file) else None


def _summary(file: BinaryIO) -> PlySummary:
    vertices, names, blocks = read_rows(file, ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2"))
    step = max(1, vertices.count // SAMPLE)
    low, high = np.full(7, np.inf, np.float32), np.full(7, -np.inf, np.float32)
    count, transparent, sample = 0, 0, []
    for rows, _ in blocks:
        if not len(rows):
            continue
        low, high = np.minimum(low, rows.min(axis=0)), np.maximum(high, rows.max(axis=0))
        transparent += int((rows[:, 3] < NEARLY_TRANSPARENT).sum())
        sample.append(rows[-count % step :: step].copy())
        count += len(rows)
    sampled = np.concatenate(sample)
    check_not_activated(sampled[:, :3], sampled[:, 4:], np.stack([low, high])[:, 3])
    degree = math.isqrt((len(names) - 11) // 3) - 1
    return PlySummary(count, degree, low[:3], high[:3], transparent)
