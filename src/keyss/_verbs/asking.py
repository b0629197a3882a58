"""What `hide` and `plan` are asked for, checked before any work."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations

from keyss.core.errors import UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Scene
from keyss.keys import DerivedKey, KeyDerivation
from keyss.methods import registry
from keyss.methods.base import Method, MethodOptions, SceneInput
from keyss.rendering.orbit import is_model
from keyss.runs.config import PathLike, path_of
from keyss.runs.opening import as_3dgs_model

_READERS = 2  # files that are read at once


@dataclass(frozen=True)
class Secret:
    """A scene, a model or the file of one to hide, and the key to it where the method has keys."""

    scene: PathLike | Scene | Gaussians
    key: str = field(default="", repr=False)
    model: PathLike | Gaussians | None = None  # a plain 3DGS model of it, if there is one already


def method_for(chosen: str | MethodOptions, secrets: Sequence[Secret]) -> tuple[Method, MethodOptions]:
    """A method and its options. Raises UsageError for as many secrets, or for keys, as it cannot have."""
    if isinstance(chosen, MethodOptions):
        method, options = registry.of_options(chosen), chosen
    else:
        method = registry.get(chosen)
        options = next(iter(method.presets.values()))
    if not 1 <= len(secrets) <= method.most_secrets:
        raise UsageError(
            f"expected 1 to {method.most_secrets} secrets for the method {method.name}, got {len(secrets)}"
        )
    keys = [secret.key for secret in secrets]
    if method.capabilities.keys:
        check_keys(keys)
    elif any(keys):
        raise UsageError(
            f"the method {method.name} has no keys: whoever has what it hands over sees the secret; give none"
        )
    return method, options


def inputs_of(
    sources: Sequence[PathLike | Scene | Gaussians], models: Sequence[PathLike | Gaussians | None]
) -> list[SceneInput]:
    """Scenes and the plain models that are given with them, or that they are. Raises UsageError."""
    asked: list[tuple[PathLike | Gaussians | None, bool]] = []  # models, and whether there are photos
    for index, (source, model) in enumerate(zip(sources, models, strict=True)):
        photos = isinstance(source, Scene) or not is_model(source)
        if not photos:
            if model is not None and model is not source and path_of(model) != (path_of(source) or ""):
                argument = "model" if index else "cover_model"
                what = "a source in memory" if isinstance(source, Gaussians) else source
                raise UsageError(f"{what} is a model itself and needs no other: leave out `{argument}`")
            model = source  # type: ignore[assignment]
        asked.append((model, photos))
    names = ["the cover"] + ["the secret"] * (len(asked) - 1)
    # Large files take seconds each, most of it outside of Python's lock.
    with ThreadPoolExecutor(_READERS) as readers:
        found = readers.map(_drawable, [model for model, _ in asked], names)
        return [SceneInput(model, photos) for model, (_, photos) in zip(found, asked, strict=True)]


def _drawable(model: PathLike | Gaussians | None, what: str) -> Gaussians | None:
    """The model if there is one. Raises UsageError where nothing of it can be seen."""
    found = None if model is None else as_3dgs_model(model, what)
    if found is not None and not (found.opacities >= DRAWN_OPACITY).any():
        raise UsageError(f"nothing of {what}'s model can be seen: all of its Gaussians are transparent")
    return found


def check_keys(keys: Sequence[str]) -> None:
    """Raise UsageError for keys that cannot be, or are the same to key derivation, before any work."""
    cheap = KeyDerivation(salt=bytes(16), time_cost=1, memory_kib=8 * 1024, parallelism=1)
    derived = [DerivedKey(key, cheap) for key in keys]
    for (i, a), (j, b) in combinations(enumerate(derived, 1), 2):
        if a.equals(b):
            raise UsageError(
                f"secrets {i} and {j} have the same key, which can open one of them only: give each its own "
                "(`keyss keygen` makes one)"
            )
