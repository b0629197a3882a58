"""Finds the model in the output folder of another program's training."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

from keyss.core.errors import KeyssWarning
from keyss.files.file_kinds import CHECKPOINTS, identify_file

# Models written by the trainers of Inria and gsplat, and by Nerfstudio's export; `*` is the number of steps.
_MODELS = (
    "point_cloud/iteration_*/point_cloud.ply",
    "iteration_*/point_cloud.ply",
    "point_cloud.ply",
    "ply/point_cloud_*.ply",
    "point_cloud_*.ply",
    "splat.ply",
    "exports/splat/splat.ply",
)
_CHECKPOINTS = ("ckpts/*.pt", "nerfstudio_models/*.ckpt", "chkpnt*.pth", "*.ckpt")
# Not the output of a training: scenes, which may have a model beside their photos, and keyss runs.
_OTHERS = (
    *("transforms.json", "transforms_train.json", "sparse", "cameras.bin", "cameras.txt", "colmap"),
    *("publish", "private"),
)


def is_training(folder: Path | str) -> bool:
    """True for a training's output folder that contains a model."""
    return _latest_model(Path(folder)) is not None


def model_file(path: Path | str) -> Path:
    """The latest model in a training's output folder, with a KeyssWarning; any other path unchanged."""
    path = Path(path)
    if found := _latest_model(path):
        warnings.warn(
            f"{path}: output of a training; its model is {found.relative_to(path)}",
            KeyssWarning,
            stacklevel=2,
        )
    return found or path


def identify_folder(folder: Path) -> str | None:
    """`identify_file` for a folder that is neither a scene nor a model; None if unknown."""
    if any(True for each in _CHECKPOINTS for _ in folder.glob(each)):
        return f"a folder of {CHECKPOINTS}"
    unpacked = folder / "meta.json"
    return identify_file(unpacked) if unpacked.is_file() else None


def _latest_model(folder: Path) -> Path | None:
    if not os.path.isdir(folder) or any(os.path.lexists(folder / each) for each in _OTHERS):
        return None
    for pattern in _MODELS:
        models = {str(each.relative_to(folder)): each for each in folder.glob(pattern) if each.is_file()}
        if models:
            return models[max(models, key=lambda name: [int(step) for step in re.findall(r"[0-9]+", name)])]
    return None
