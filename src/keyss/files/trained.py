"""The model in the folder of another program's training."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

from keyss.core.errors import KeyssWarning
from keyss.files.foreign import CHECKPOINTS, what_it_is

# Where Inria's trainer, gsplat's and Nerfstudio's export write models; `*` is the number of steps.
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
# A scene may have a model beside its photos, and a keyss run has more than one.
_OTHERS = (
    *("transforms.json", "transforms_train.json", "sparse", "cameras.bin", "cameras.txt", "colmap"),
    *("publish", "private"),
)


def is_training(folder: Path | str) -> bool:
    """True for the folder of a training that has a model."""
    return _found(Path(folder)) is not None


def model_file(path: Path | str) -> Path:
    """Of the folder of a training the latest model, with a KeyssWarning; all other paths as they are."""
    path = Path(path)
    if found := _found(path):
        warnings.warn(
            f"{path}: a folder of a training; its model is {found.relative_to(path)}",
            KeyssWarning,
            stacklevel=2,
        )
    return found or path


def kind_of_folder(folder: Path) -> str | None:
    """`what_it_is` for a folder that is neither a scene nor a model, None if it is of no known kind."""
    if any(True for each in _CHECKPOINTS for _ in folder.glob(each)):
        return f"a folder of {CHECKPOINTS}"
    unpacked = folder / "meta.json"
    return what_it_is(unpacked) if unpacked.is_file() else None


def _found(folder: Path) -> Path | None:
    if not os.path.isdir(folder) or any(os.path.lexists(folder / each) for each in _OTHERS):
        return None
    for pattern in _MODELS:
        models = [each for each in folder.glob(pattern) if each.is_file()]
        if models:
            return max(models, key=lambda each: _numbers(each.relative_to(folder)))
    return None


def _numbers(path: Path) -> list[int]:
    return [int(each) for each in re.findall(r"[0-9]+", str(path))]
