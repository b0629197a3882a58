"""The verb `info`: descriptions of files and folders.

For a plain .ply, imports neither torch nor the modules for folders, which would take a second.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from keyss.channels.names import Format
from keyss.core.errors import InputError, UsageError
from keyss.files.file_kinds import identify_file, is_training, is_unpacked_sog, model_file
from keyss.files.inputs import is_standard
from keyss.files.ply_table import NEARLY_TRANSPARENT, summarise_ply

# Of a hidden model, by SH degree: `usual_size` of six models is 14 to 17, and 10 to 12.
_BYTES_PER_GAUSSIAN = {3: 17, 0: 12}

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
class InterruptedRun:
    """A folder of `hide` or `fit` that was not finished."""

    kind: str
    path: str
    state: str  # what continues it


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
    capacity: tuple[str, ...] | None = None  # one per way to publish; only on request, as it takes seconds


@dataclass(frozen=True)
class SceneInfo:
    """A folder of posed photos."""

    kind: str
    name: str
    train_views: int
    test_views: int
    image_sizes: tuple[str, ...]  # "WIDTH x HEIGHT", of most photos first
    points: int
    extent: float  # world units
    background: tuple[float, ...]


def info(path: str | Path, *, capacity: bool = False) -> RunInfo | InterruptedRun | ModelInfo | SceneInfo:
    """Describe a model ("-" for standard input), a scene folder, or a folder of results. Raises InputError.

    `capacity`: also what a model can hide in each format and channel; raises UsageError for folders without
    one model.

    Skips photos of a scene that are missing or damaged, with a KeyssWarning.
    """
    path = Path(path)
    try:
        if not (is_standard(path) or path.exists()):
            raise InputError(f"{path} does not exist")
        if path.is_dir() and not (is_unpacked_sog(path) or is_training(path)):
            return _folder_info(path, capacity)
        return _model_info(model_file(path), capacity)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _folder_info(path: Path, capacity: bool) -> RunInfo | InterruptedRun | ModelInfo | SceneInfo:
    from keyss.files.scenes import load_scene
    from keyss.runs.files import METRICS, MODEL, is_run, model_in
    from keyss.runs.folder import HIDE_FILES, read_manifest
    from keyss.runs.json_records import read_record
    from keyss.runs.run_records import FitMetrics, HideMetrics

    manifest = read_manifest(path)
    if (running := manifest.running) is not None and running.stage != "audit":  # an audit leaves the run
        state = "interrupted: the same command with --resume continues it, --overwrite drops it"
        return InterruptedRun(f"unfinished {running.stage}", str(path), state)
    if inside := model_in(path):
        if not (path / METRICS).exists():  # hidden files have none, and `private/` may have been deleted
            described = _model_info(inside, capacity)
            return replace(described, kind="hiding of files") if HIDE_FILES in manifest.files else described
        if capacity:
            raise UsageError(f"{path}: `capacity` is of a model: give one, such as {inside}")
        if inside == path / MODEL:
            return RunInfo("plain model", str(path), read_record(path / METRICS, FitMetrics))
        return RunInfo("hiding", str(path), read_record(path / METRICS, HideMetrics))
    if runs := sorted(folder for folder in (*path.iterdir(), *path.glob("trials/*/run")) if is_run(folder)):
        raise InputError(f"{path}: expected a run, found a folder of runs; give one, such as {runs[0]}")
    if is_run(path.absolute().parent):
        raise InputError(f"{path}: expected a run, found a folder in one; give {path.parent}")
    if capacity:
        raise UsageError(f"{path}: `capacity` is of a model, which `keyss fit` makes from a scene")
    scene = load_scene(path, skip_missing=True)
    sizes = Counter(f"{view.camera.width} x {view.camera.height}" for view in scene.views)
    return SceneInfo(
        kind="scene",
        name=scene.name,
        train_views=len(scene.train),
        test_views=len(scene.test),
        image_sizes=tuple(size for size, _ in sizes.most_common()),
        points=len(scene.points),
        extent=round(scene.extent, 4),
        background=_round(scene.background),
    )


def _model_info(path: Path, capacity: bool = False) -> ModelInfo:
    capacities = None
    if (summary := None if capacity else summarise_ply(path)) is not None:
        count, degree, transparent = summary.gaussians, summary.sh_degree, summary.nearly_transparent
        low, high = _round(summary.low), _round(summary.high)
    else:
        from keyss.files.model_formats import known_suffixes
        from keyss.files.models import is_model_source, read_model

        if not (is_standard(path) or is_model_source(path)):
            raise InputError(
                f"{path}: expected a model ({known_suffixes()}), a scene folder or a result folder, found "
                f"{identify_file(path)}"
            )
        model = read_model(path)
        count, degree = len(model), model.sh_degree
        low, high = _round(model.means.amin(0)), _round(model.means.amax(0))
        transparent = int((model.opacity_logits < NEARLY_TRANSPARENT).sum())
        capacities = tuple(_capacities(model)) if capacity else None
    files = [path, *(path.parent.glob("*.webp") if is_unpacked_sog(path) else ())]
    return ModelInfo(
        kind="3DGS model",
        path=str(path),
        bytes=None if is_standard(path) else sum(file.stat().st_size for file in files),
        gaussians=count,
        sh_degree=degree,
        bounding_box=(low, high),
        nearly_transparent=round(transparent / count, 4),
        capacity=capacities,
    )


def _capacities(model: Gaussians) -> Iterator[str]:
    """What a model can hide in each format and channel."""
    from keyss.channels import APPENDED, channel_for

    ways: list[tuple[str, Any]] = [
        *((f"--format {name}", ("unchanged", "appended", name)) for name in get_args(Format)),
        ("--publish converted --channel colours", ("converted", "colours", None)),
    ]
    for flags, (publish, channel, format) in ways:
        try:
            used = channel_for(publish, channel, format, model)
            room = used.prepare(model).capacity
        except UsageError as error:
            yield f"{flags}: nothing ({error})"
            continue
        sizes = (
            f"{room.bytes // size:,} Gaussians of SH degree {n}" for n, size in _BYTES_PER_GAUSSIAN.items()
        )
        yield f"{flags}: {room.bytes:,} bytes in {used.place}, a model of about {' or '.join(sizes)}"
    yield f"--publish converted: {APPENDED.estimate_capacity(0, 0).bytes:,} bytes; the file grows"


def _round(values: Iterable[Any]) -> tuple[float, ...]:
    return tuple(round(float(x), 4) for x in values)
