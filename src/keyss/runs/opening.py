"""A folder that `hide` made, opened with its keys: what evaluating and auditing start from."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.foreign import what_it_is
from keyss.files.models import known_suffixes, read_model
from keyss.files.reading import read_file
from keyss.files.scenes import load_scene
from keyss.measure.robustness.survival import Reopener
from keyss.methods import handed, registry
from keyss.methods.base import MethodOptions, Opened
from keyss.rendering.orbit import is_model, scene_of_model
from keyss.runs.config import Background, PathLike, RunConfig, read_config, secret_ids
from keyss.runs.files import (
    CONFIG,
    METRICS,
    bound_names,
    handed_names,
    is_run,
    model_in,
    plain_names,
    run_folder,
    stego_in,
)
from keyss.runs.metrics import HideMetrics
from keyss.runs.records import read_record

OPENS_NOTHING = (
    "this key opens nothing here: it may be another key or misspelt; the file may not be as it was published "
    "(converted or quantised, moved, scaled, pruned, edited or trained on); it may be a file that is "
    "hidden, which comes out under a name that is no model's; or nothing is hidden here"
)


@dataclass(frozen=True)
class HidingRun:
    """What a run published, what its keys open in it, and from what it was made."""

    folder: Path
    config: RunConfig[MethodOptions]
    metrics: HideMetrics
    stego: Gaussians
    opened: tuple[Opened, ...]  # in the order of the secrets
    keys: tuple[str, ...] = field(repr=False)  # in the same order; "" where the method has none
    sources: tuple[str, ...]  # of the cover, then of the secrets: scene folders, or models without photos

    @property
    def reopeners(self) -> list[Reopener]:
        """What opens the secrets in a changed model; what was handed over does not change."""
        if registry.get(self.config.method).capabilities.hands_over:
            return [Reopener("", lambda stego, key, own=own: own) for own in self.opened]  # type: ignore[misc]
        return [Reopener(key, registry.open_model) for key in self.keys]

    def scenes(self, *, train_pictures: bool = True) -> list[Scene]:
        """The cover and the secrets with their photos, or with pictures of the models that they are."""
        return [
            as_scene(
                source,
                self.config.width,
                self.config.background,
                train_pictures=train_pictures,
                skip_missing=self.config.skip_missing,
            )
            for source in self.sources
        ]

    def plain_models(self) -> list[Gaussians | None]:
        """Plain models of the cover and of the secrets, in their own frames; None where there is none."""
        found: list[Gaussians | None] = []
        for name, source in zip(plain_names(len(self.opened)), self.sources, strict=True):
            path = self.folder / name
            path = Path(source) if not path.exists() and is_model(source) else path
            found.append(read_model(path) if path.exists() else None)
        return found

    def baselines(self) -> list[Gaussians | None]:
        """What cover and secrets are compared with: `plain_models`, or those that were trained for longer."""
        bounds = [self.folder / name for name in bound_names(len(self.opened))]
        return [
            read_model(bound) if bound.exists() else plain
            for bound, plain in zip(bounds, self.plain_models(), strict=True)
        ]


def open_run(run: PathLike, keys: Sequence[str]) -> HidingRun:
    """A folder that `hide` made, with what `keys` open in it: those of all its secrets, in any order.

    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key and for a run on
    scenes that were in memory only, InputError for a folder that is not one of `hide`.
    """
    folder = run_folder(Path(run))
    config, metrics = read_config(folder / CONFIG), read_record(folder / METRICS, HideMetrics)
    sources = tuple(source for source in (config.cover, *config.secrets) if source is not None)
    if len(sources) <= len(config.secrets):
        raise UsageError(f"{folder} was made from scenes in memory: there are no photos to evaluate against")
    stego = read_model(stego_in(folder))
    capabilities = registry.get(config.method).capabilities
    if not capabilities.keys:
        if keys:
            raise UsageError(f"the method {config.method} has no keys: give none")
        keys = [""] * len(config.payloads)
    if capabilities.hands_over:
        every = [
            read_handed(folder / name, key or None)
            for name, key in zip(handed_names(len(config.payloads)), keys, strict=False)
        ]
    else:
        every = [open_in(stego, key) for key in keys]
    names = secret_ids(config.options.fit.known_seed, every)
    found = dict(zip(names, zip(every, keys, strict=False), strict=True))
    if set(found) != set(config.payloads):
        raise UsageError(
            f"expected the keys of all {len(config.payloads)} secret(s), got {len(found)} of them"
        )
    secrets, own = zip(*(found[each] for each in config.payloads), strict=True)
    return HidingRun(folder, config, metrics, stego, secrets, own, sources)


def read_handed(path: PathLike, key: str | None) -> Opened:
    """The secret in a file that was handed over; see `registry.open_handed`."""
    data = read_file(Path(path), handed.MOST_BYTES)
    try:
        return registry.open_handed(data, key)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def is_sealed(path: PathLike) -> bool:
    """Whether it takes a key to open a file that was handed over. Raises InputError."""
    return handed.is_sealed(read_file(Path(path), handed.MOST_BYTES))


def open_in(stego: Gaussians, key: str, *, decoy: bool = False) -> Opened:
    """The secret that the key opens; see `registry.open_model`."""
    with naming_what_opens_nothing():
        return registry.open_model(stego, key, decoy=decoy)


@contextmanager
def naming_what_opens_nothing() -> Iterator[None]:
    """A key that opens nothing is told so in the same words whatever there is."""
    try:
        yield
    except WrongKeyError as error:
        raise WrongKeyError(OPENS_NOTHING) from error


def as_scene(
    source: PathLike | Scene | Gaussians,
    width: int | None,
    background: Background,
    *,
    train_pictures: bool = True,
    skip_missing: bool = False,
    model: Gaussians | None = None,
) -> Scene:
    """A scene, the photos in a folder, or what a model or the one in its file shows from all around.

    `train_pictures`: see `scene_of_model`. `skip_missing`: see `load_scene`. `model`: what is in
    the file of a model, where it has been read.
    """
    if isinstance(source, Scene):
        return source
    if not isinstance(source, Gaussians) and not is_model(source):
        if os.path.exists(source) and not os.path.isdir(source):
            found = what_it_is(Path(source))
            raise InputError(
                f"{source}: expected a scene folder or a 3DGS model ({known_suffixes()}), found {found}"
            )
        try:
            return load_scene(source, width=width, background=background, skip_missing=skip_missing)
        except InputError as error:
            if is_run(Path(source)) and (inside := model_in(Path(source))):
                raise InputError(f"{source}: expected a scene, found a run; its model is {inside}") from error
            raise
    name = "model" if isinstance(source, Gaussians) else Path(source).stem
    shown = as_model(source) if model is None else model
    return scene_of_model(shown, name, size=width, background=background, train_pictures=train_pictures)


def as_model(source: PathLike | Gaussians) -> Gaussians:
    """A model, or the one in a file, on the CPU. Raises InputError, which knows folders of runs."""
    if isinstance(source, Gaussians):
        return source.to("cpu")
    if inside := model_in(Path(source)):
        raise InputError(f"{source}: expected the file of a 3DGS model, found a folder; give {inside}")
    return read_model(source)


def as_3dgs_model(source: PathLike | Gaussians, what: str) -> Gaussians:
    """`as_model`, and UsageError where a network makes its pictures."""
    found = as_model(source)
    if isinstance(found, DecodedGaussians):
        raise UsageError(f"a network makes the pictures of {what}'s model: expected a 3DGS model")
    return found
