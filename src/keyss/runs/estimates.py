"""Rough times of work on files of models, for the line that says how long it takes.

`benchmarks/estimates.py` measures the rates. Does not import torch.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from keyss.core.errors import InputError
from keyss.files.file_kinds import model_file
from keyss.files.ply_table import is_plain, read_vertices

_BYTES = 16  # of a Gaussian in a compressed file
_START = 2.0  # seconds to import what the commands need
# Seconds for a million Gaussians of SH degree 3, on two cores of an x86-64 machine.
_SECONDS = {
    "info": 0.2,
    "verify": 1.0,
    "reveal": 8.0,
    "hide a file": 8.0,
    "export": 2.0,
    "render": 10.0,
    ".compressed.ply": 4.0,  # before its own end
    ".ply": 3.0,
    ".spz": 5.0,
    ".sog": 20.0,
    ".glb": 4.0,
    ".splat": 3.0,
}


def seconds_for(task: str, model: Path) -> float:
    """About the seconds that a task takes: one of `_SECONDS`, where suffixes are formats to write."""
    return _START + _SECONDS[task] * gaussians_in(model) / 1e6


def seconds_to_convert(model: Path, out: Path, keys: int) -> float:
    """About the seconds to convert a model and to open its secrets before and after."""
    suffix = next((each for each in _SECONDS if each.startswith(".") and out.name.endswith(each)), ".ply")
    return seconds_for(suffix, model) + 2 * keys * (seconds_for("reveal", model) - _START)


def gaussians_in(path: Path) -> float:
    """About the number of Gaussians in a file, from its header or its size; 0 if it cannot be read."""
    with suppress(InputError, OSError, ValueError):
        path = model_file(path)
        with path.open("rb") as file:
            if is_plain(file):
                return read_vertices(file).count
        return path.stat().st_size / _BYTES
    return 0.0
