"""Arguments and result of `hide`. Arguments are checked before any work."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations

from keyss.api.model_frames import in_frame_of
from keyss.core.errors import UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.keys import normalized_key
from keyss.methods import registry
from keyss.methods.method import Method, MethodOptions, Plan, Source
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike, as_3dgs_model, as_scene, path_of
from keyss.runs.planning import Cost
from keyss.runs.run_records import HideMetrics

_READERS = 2  # threads that read files


@dataclass(frozen=True)
class Secret:
    """A scene to hide, and its key (methods without keys take none)."""

    scene: PathLike | Scene | Gaussians  # folder of photos, or model
    key: str = field(default="", repr=False)
    model: PathLike | Gaussians | None = None  # plain 3DGS model of the scene, fitted if there is none


@dataclass(frozen=True)
class HideResult:
    """The result of `hide`."""

    stego: Gaussians | None = None  # publish this; None after a dry run
    metrics: HideMetrics | None = None  # None after a dry run
    plan: Plan | None = None  # only after a dry run, like `cost`
    cost: Cost | None = None
    survives: bool = False  # whether the secrets survive conversion to other formats


def method_for(
    chosen: str | MethodOptions, secrets: Sequence[Secret], preset: str | None, device: str
) -> tuple[Method, MethodOptions]:
    """A method and its options, by default its preset for the device.

    Raises UsageError if the method does not support these secrets or keys.
    """
    if isinstance(secrets, Secret) or not isinstance(secrets, Sequence) or isinstance(secrets, str):
        raise UsageError("secrets: expected a list, such as [Secret(scene, key)]")
    for each in secrets:
        if not isinstance(each, Secret):
            raise UsageError(f"secrets: expected Secret(scene, key), got {type(each).__name__}")
    if isinstance(chosen, MethodOptions):
        method, options = registry.of_options(chosen), chosen
        if preset is not None:
            raise UsageError("`preset` is for a method's name: options have their own schedule")
    else:
        method = registry.get(chosen)
        options = method.options.preset(preset or "default", device)
    if not 1 <= len(secrets) <= method.max_secrets:
        raise UsageError(
            f"expected 1 to {method.max_secrets} secrets for the method {method.name}, got {len(secrets)}"
        )
    keys = [secret.key for secret in secrets]
    if method.capabilities.keys:
        check_keys(keys)
    elif any(keys):
        raise UsageError(
            f"the method {method.name} has no keys, as whoever has both files can see the secret: give none"
        )
    return method, options


def sources_of(
    sources: Sequence[PathLike | Scene | Gaussians],
    models: Sequence[PathLike | Gaussians | None],
    keys: Sequence[str],
    views: ViewOptions,
) -> list[Source]:
    """The cover and the secrets with their photos and plain models; a source may be its own model.

    `keys`: one per secret. Raises UsageError and InputError.
    """
    given: list[tuple[PathLike | Gaussians | None, bool]] = []  # models, and whether there are photos
    for index, (source, model) in enumerate(zip(sources, models, strict=True)):
        photos = isinstance(source, Scene) or not is_model(source)
        if not photos:
            if model is not None and model is not source and path_of(model) != (path_of(source) or ""):
                argument = "model" if index else "cover_model"
                what = "a source in memory" if isinstance(source, Gaussians) else source
                raise UsageError(f"{what} is a model itself: leave out `{argument}`")
            model = source  # type: ignore[assignment]
        given.append((model, photos))
    names = ["the cover"] + ["the secret"] * (len(given) - 1)
    # Reading large files takes seconds each, mostly without the GIL.
    with ThreadPoolExecutor(_READERS) as readers:
        found = readers.map(_read_visible, [model for model, _ in given], names)
        loaded = [
            as_scene(source, views) if photos else None
            for source, (_, photos) in zip(sources, given, strict=True)
        ]
        placed = [
            in_frame_of(scene, scene.to_scene_frame(model), path, source)
            if scene is not None and model is not None and path is not None
            else model
            for model, scene, source, (path, _) in zip(found, loaded, sources, given, strict=True)
        ]
        return [
            Source(model, photos, key, scene)
            for model, (_, photos), key, scene in zip(placed, given, ["", *keys], loaded, strict=True)
        ]


def _read_visible(model: PathLike | Gaussians | None, what: str) -> Gaussians | None:
    """Read the model, if there is one. Raises UsageError if all of it is transparent."""
    found = None if model is None else as_3dgs_model(model, what)
    if found is not None and not (found.opacities >= DRAWN_OPACITY).any():
        raise UsageError(f"{what}'s model is invisible: all of its Gaussians are transparent")
    return found


def check_keys(keys: Sequence[str]) -> None:
    """Raise UsageError for invalid keys, and for two keys that normalise to the same text."""
    for (i, a), (j, b) in combinations(enumerate(map(normalized_key, keys), 1), 2):
        if a == b:
            raise UsageError(
                f"secrets {i} and {j} have the same key, which could open only one of them: give each its "
                "own (see `keyss keygen`)"
            )
