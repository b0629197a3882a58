"""The verb `info`: what is in a file or a folder.

What one kind of them needs is imported where it is used: all of it together takes seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from keyss.core.errors import InputError
from keyss.files.foreign import what_it_is
from keyss.files.streams import is_standard

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from keyss.core.scene import Scene
    from keyss.runs.metrics import FitMetrics, HideMetrics

Corner = tuple[float, ...]  # [3] world units


@dataclass(frozen=True)
class RunInfo:
    """A folder of `hide` or `fit`."""

    kind: str
    path: str
    metrics: HideMetrics | FitMetrics


@dataclass(frozen=True)
class ModelInfo:
    """A model's file; it does not tell whether something is hidden in it."""

    kind: str
    path: str
    bytes: int | None  # None: of standard input
    gaussians: int
    sh_degree: int
    bounding_box: tuple[Corner, Corner]
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
    """What is in a model, "-" for standard input, a scene folder or a folder of results. Raises InputError.

    Photos that a scene names but that are not there are left out, with a KeyssWarning.
    """
    try:
        return _info(Path(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _info(path: Path) -> RunInfo | ModelInfo | SceneInfo:
    if not is_standard(path):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_dir():
            return _folder_info(path)

    if path.suffix.lower() == ".ply" and (rows := _ply_rows(path)) is not None:
        return _table_info(path, *rows)

    from keyss.files.models import is_model_path, known_suffixes

    if not (is_standard(path) or is_model_path(path)):
        raise InputError(
            f"{path}: expected a model ({known_suffixes()}), a scene folder or a result folder, found "
            f"{what_it_is(path)}"
        )
    return _model_info(path)


def _folder_info(path: Path) -> RunInfo | SceneInfo:
    from keyss.files.scenes import load_scene
    from keyss.runs.files import METRICS, MODEL, stego_in
    from keyss.runs.metrics import FitMetrics, HideMetrics
    from keyss.runs.records import read_record

    if stego_in(path).exists():
        return RunInfo("hiding", str(path), read_record(path / METRICS, HideMetrics))
    if (path / MODEL).exists():
        return RunInfo("plain model", str(path), read_record(path / METRICS, FitMetrics))
    return _scene_info(load_scene(path, skip_missing=True))


def _ply_rows(path: Path) -> tuple[list[str], NDArray[np.float32]] | None:
    """Of a model in plain PLY the properties' names and values; None for whatever else has its name."""
    from keyss.files.ply_rows import is_compressed, read_rows

    with path.open("rb") as file:
        begins = file.read(3) == b"ply"
    return read_rows(path) if begins and not is_compressed(path) else None


def _table_info(path: Path, names: list[str], rows: NDArray[np.float32]) -> ModelInfo:
    """Without torch, which takes longer to load than all the rest; other formats are unpacked with it."""
    import numpy as np

    logits = rows[:, names.index("opacity")]
    low, high = rows[:, :3].min(axis=0), rows[:, :3].max(axis=0)
    return ModelInfo(
        kind="3DGS model",
        path=str(path),
        bytes=path.stat().st_size,
        gaussians=len(rows),
        sh_degree=round(((len(names) - 11) // 3) ** 0.5) - 1,
        bounding_box=(_rounded(low), _rounded(high)),
        nearly_transparent=round(float((logits < np.log(0.05 / 0.95)).mean()), 4),
    )


def _model_info(path: Path) -> ModelInfo:
    from keyss.files.models import read_model

    model = read_model(path)
    return ModelInfo(
        kind="3DGS model",
        path=str(path),
        bytes=None if is_standard(path) else path.stat().st_size,
        gaussians=len(model),
        sh_degree=model.sh_degree,
        bounding_box=(_rounded(model.means.amin(0)), _rounded(model.means.amax(0))),
        nearly_transparent=round(float((model.opacities < 0.05).float().mean()), 4),
    )


def _scene_info(scene: Scene) -> SceneInfo:
    camera = scene.train[0].camera
    return SceneInfo(
        kind="scene",
        name=scene.name,
        train_views=len(scene.train),
        test_views=len(scene.test),
        image_size=(camera.width, camera.height),
        points=len(scene.points),
        extent=round(scene.extent, 4),
        background=_rounded(scene.background),
    )


def _rounded(values: Tensor | Iterable[float]) -> tuple[float, ...]:
    return tuple(round(float(x), 4) for x in values)
