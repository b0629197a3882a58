"""Arguments and result of `hide`. Arguments are checked before any work."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

from keyss.api.model_frames import in_frame_of
from keyss.core.errors import UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.models import is_model_path
from keyss.keys import normalized_key
from keyss.methods import registry
from keyss.methods.method import Method, MethodOptions, Plan, Source
from keyss.rendering.orbit import is_model
from keyss.runs.files import METRICS, MODEL, PathLike, as_3dgs_model, as_scene, path_of
from keyss.runs.json_records import read_record
from keyss.runs.planning import Cost
from keyss.runs.run_records import FitMetrics, HideMetrics

_READERS = 2  # threads that read files


@dataclass(frozen=True)
class Secret:
    """A scene to hide, and its key (methods without keys take none)."""

    scene: PathLike | Scene | Gaussians  # folder of photos, or model
    key: str = field(default="", repr=False)
    model: PathLike | Gaussians | None = None  # plain 3DGS model of the scene, fitted if there is none


@dataclass(frozen=True)
class SecretFile:
    """A file to hide, and its key."""

    file: PathLike | bytes
    key: str = field(repr=False)
    name: str = ""  # displayed when the file is revealed; default: its own name


@dataclass(frozen=True)
class HideResult:
    """The result of `hide`."""

    stego: Gaussians | None = None  # publish this; None after a dry run
    metrics: HideMetrics | None = None  # quality of hidden scenes; None after a dry run
    plan: Plan | None = None  # for hidden scenes, after a dry run, like `cost`
    cost: Cost | None = None
    survives: bool = False  # whether the secrets survive conversion to other formats
    psnr: float | None = None  # of hidden files: dB of the stego model's views to the cover's, at most 120


def method_for(
    chosen: str | MethodOptions,
    preset: str,
    secrets: Sequence[Secret] | Sequence[SecretFile],
    device: str,
) -> tuple[Method, MethodOptions]:
    """A method and its options, by default those of its `preset` for the device.

    Raises UsageError if the method does not support these secrets or keys, and for a preset beside options.
    """
    kinds = set(map(type, secrets)) if isinstance(secrets, Sequence) else {type(secrets)}
    if len(kinds) > 1 or kinds - {Secret, SecretFile} or not isinstance(secrets, Sequence):
        names = " and ".join(sorted(kind.__name__ for kind in kinds))
        raise UsageError(f"secrets: expected a list of Secret(scene, key), or of SecretFile, got {names}")
    if isinstance(chosen, MethodOptions):
        if preset != "default":
            raise UsageError(f'`preset="{preset}"` is for a method that is given by name, not by its options')
        method, options = registry.of_options(chosen), chosen
    else:
        method = registry.get(chosen)
        options = method.options.preset(preset, device)
    if not 1 <= len(secrets) <= method.max_secrets:
        raise UsageError(
            f"expected 1 to {method.max_secrets} secrets for the method {method.name}, got {len(secrets)}"
        )
    if isinstance(secrets[0], SecretFile) and method.name != registry.DEFAULT:
        raise UsageError(f"the method {method.name} hides scenes only, no files")
    keys = [secret.key for secret in secrets]
    if method.capabilities.keys:
        _check_keys(keys)
    elif any(keys):
        raise UsageError(
            f"the method {method.name} has no keys, as whoever has both files can see the secret: give none"
        )
    return method, options


def check_arguments(out: PathLike | None, min_psnr: float | None) -> None:
    """Raise UsageError for the name of a model as the folder, and for a limit that is not a number."""
    if out is not None and is_model_path(out):
        raise UsageError(
            f"{out}: expected the name of a folder; the format of the model in it follows from `publish`"
        )
    if min_psnr is not None and not math.isfinite(min_psnr):
        raise UsageError(f"`min_psnr`: expected a number of dB, got {min_psnr}")


def check_not_given(**for_scenes: object) -> None:
    """Raise UsageError for an argument that hidden files do not use."""
    for name, value in for_scenes.items():
        if value is not None and value is not False:
            raise UsageError(f"`{name}` is for hidden scenes, not for files: leave it out")


def read_sources(given: Sequence[Secret], views: ViewOptions) -> list[Source]:
    """Read photos and models of the cover and the secrets. Raises UsageError and InputError."""
    names = ["the cover"] + ["the secret"] * (len(given) - 1)
    places = list(map(_place_of_model, given, names))
    # Reading large files takes seconds each, mostly without the GIL.
    with ThreadPoolExecutor(_READERS) as readers:
        models = readers.map(_read_visible, places, names)
        scenes = [None if is_model(one.scene) else as_scene(one.scene, views) for one in given]
        sources = []
        for one, place, scene, model in zip(given, places, scenes, models, strict=True):
            if model is not None and scene is not None and place is not None:
                model = in_frame_of(scene, scene.to_scene_frame(model), place, one.scene)
            sources.append(Source(model, scene is not None, one.key, scene, _steps_of(one.model)))
    return sources


def _place_of_model(given: Secret, name: str) -> PathLike | Gaussians | None:
    """The plain model of a scene, which may be a model itself. Raises UsageError for two models."""
    scene, model = given.scene, given.model
    if not is_model(scene):
        return model
    if model is not None and model is not scene and path_of(model) != (path_of(scene) or ""):
        argument = "cover_model" if name == "the cover" else "model"
        what = "a source in memory" if isinstance(scene, Gaussians) else scene
        raise UsageError(f"{what} is a model itself: leave out `{argument}`")
    return scene


def with_renders(
    given: Sequence[Secret], sources: Sequence[Source], views: ViewOptions, *, train: bool
) -> list[Source]:
    """Render the images of scenes without photos; `train`: those of training views too."""
    return [
        source
        if source.photos
        else replace(source, loaded=as_scene(one.scene, views, train_pictures=train, model=source.given))
        for one, source in zip(given, sources, strict=True)
    ]


def _steps_of(model: PathLike | Gaussians | None) -> int | None:
    """Training steps of a given plain model, if `fit` wrote it."""
    if model is None or isinstance(model, Gaussians) or Path(model).name != MODEL:
        return None
    metrics = Path(model).parent / METRICS
    return read_record(metrics, FitMetrics).iterations if metrics.is_file() else None


def _read_visible(source: PathLike | Gaussians | None, what: str) -> Gaussians | None:
    """Read the model, if there is one. Raises UsageError if all of it is transparent."""
    model = None if source is None else as_3dgs_model(source, what)
    if model is not None and not (model.opacities >= DRAWN_OPACITY).any():
        raise UsageError(f"{what}'s model is invisible: all of its Gaussians are transparent")
    return model


def _check_keys(keys: Sequence[str]) -> None:
    """Raise UsageError for invalid keys, and for two keys that normalise to the same text."""
    for (i, a), (j, b) in combinations(enumerate(map(normalized_key, keys), 1), 2):
        if a == b:
            raise UsageError(
                f"secrets {i} and {j} have the same key, which could open only one of them: give each its "
                "own (see `keyss keygen`)"
            )
