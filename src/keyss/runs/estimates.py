"""Rough times of reading and writing models, for progress lines.

Does not import torch.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path

from keyss.core.errors import InputError, KeyssWarning
from keyss.files.file_kinds import model_file
from keyss.files.ply_table import is_plain, read_vertices

_BYTES = 16  # per Gaussian of a compressed file
_START = 2.0  # seconds to import what the commands need
# Processor seconds for a million Gaussians of SH degree 3, on an x86-64 machine; the slowest of one kind.
_SECONDS = {
    "info": 0.3,
    "info --capacity": 40.0,
    "verify": 1.2,
    "reveal": 6.0,
    "hide a file": 20.0,
    "export": 1.0,
    "convert": 12.0,
    "convert, checking a key": 24.0,
    "render": 10.0,
    "prepare": 7.0,
}


def seconds_for(task: str, *models: object) -> float:
    """About the seconds that a task takes, one of `_SECONDS`; folders of photos do not count."""
    paths = [Path(model) for model in models if isinstance(model, str | Path)]
    return _START + _SECONDS[task] * sum(map(gaussians_in, paths)) / 1e6


def gaussians_in(path: Path) -> float:
    """About the number of Gaussians in a file, from its header or its size; 0 if it cannot be read."""
    with suppress(InputError, OSError, ValueError), warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)  # the command itself says which model it takes
        path = model_file(path)
        with path.open("rb") as file:
            if is_plain(file):
                return read_vertices(file).count
        return path.stat().st_size / _BYTES
    return 0.0
