"""The verb `info`: descriptions of files and folders.

Imports for a plain .ply neither torch nor what only folders need, which takes a second.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keyss.core.errors import InputError
from keyss.files.file_kinds import identify_file, is_training, model_file
from keyss.files.inputs import is_standard
from keyss.files.ply_summary import NEARLY_TRANSPARENT, summarise_ply

if TYPE_CHECKING:
    from keyss.core.gaussians import Gaussians
    from keyss.runs.run_records import FitMetrics, HideMetrics


@dataclass(frozen=True)
class RunInfo:
    """A folder of `hide` or `fit`."""

    kind: str
    path: str
    metrics: HideMetrics | FitMetrics


@dataclass(frozen=True)
class ModelInfo:
    """A model's file, with or without a secret."""

    kind: str
    path: str
    bytes: int | None  # None for standard input
    gaussians: int
    sh_degree: int
    bounding_box: tuple[tuple[float, ...], tuple[float, ...]]  # two corners, in world units
    nearly_transparent: float  # share of the Gaussians with opacities below 0.05


@dataclass(frozen=True)
class SceneInfo:
    """A folder of posed photos."""

    kind: str
    name: str
    train_views: int
    test_views: int
    image_size: tuple[int, int]  # width, height
    points: int
    extent: float  # world units
    background: tuple[float, ...]


def info(path: str | Path) -> RunInfo | ModelInfo | SceneInfo:
    """Describe a model ("-" for standard input), a scene folder, or a folder of results. Raises InputError.

    Skips photos that a scene names but that do not exist, with a KeyssWarning.
    """
    path = Path(path)
    try:
        if not (is_standard(path) or path.exists()):
            raise InputError(f"{path}: no such file or folder")
        return _folder_info(path) if path.is_dir() else _model_info(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _folder_info(path: Path) -> RunInfo | ModelInfo | SceneInfo:
    from keyss.files.scenes import load_scene
    from keyss.runs.files import METRICS, MODEL, is_run, model_in
    from keyss.runs.json_records import read_record
    from keyss.runs.run_records import FitMetrics, HideMetrics

    if inside := model_in(path):
        if not (path / METRICS).exists():  # hidden files have none, and `private/` may have been deleted
            return _model_info(inside)
        if inside == path / MODEL:
            return RunInfo("plain model", str(path), read_record(path / METRICS, FitMetrics))
        return RunInfo("hiding", str(path), read_record(path / METRICS, HideMetrics))
    if runs := sorted(each for each in path.iterdir() if is_run(each)):
        raise InputError(f"{path} is not a run, but a folder of {len(runs)}: name one, such as {runs[0]}")
    if is_training(path):
        return _model_info(model_file(path))
    scene = load_scene(path, skip_missing=True)
    camera = scene.train[0].camera
    return SceneInfo(
        kind="scene",
        name=scene.name,
        train_views=len(scene.train),
        test_views=len(scene.test),
        image_size=(camera.width, camera.height),
        points=len(scene.points),
        extent=round(scene.extent, 4),
        background=_round(scene.background),
    )


def _model_info(path: Path) -> ModelInfo:
    if (summary := summarise_ply(path)) is not None:
        count, degree, transparent = summary.gaussians, summary.sh_degree, summary.nearly_transparent
        box = _round(summary.low), _round(summary.high)
    else:
        model = _read_model(path)
        count, degree = len(model), model.sh_degree
        box = _round(model.means.amin(0)), _round(model.means.amax(0))
        transparent = int((model.opacity_logits < NEARLY_TRANSPARENT).sum())
    return ModelInfo(
        kind="3DGS model",
        path=str(path),
        bytes=None if is_standard(path) else path.stat().st_size,
        gaussians=count,
        sh_degree=degree,
        bounding_box=box,
        nearly_transparent=round(transparent / count, 4),
    )


def _read_model(path: Path) -> Gaussians:
    from keyss.files.models import is_model_path, known_suffixes, read_model

    if not (is_standard(path) or is_model_path(path)):
        raise InputError(
            f"{path}: expected a model ({known_suffixes()}), a scene folder or a result folder, found "
            f"{identify_file(path)}"
        )
    return read_model(path)


def _round(values: Iterable[Any]) -> tuple[float, ...]:
    return tuple(round(float(x), 4) for x in values)
