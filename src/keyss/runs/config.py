"""`config.json`: what a run was told, and by which a later one finds its scenes again."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from torch import Tensor

from keyss._version import __version__
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.methods import registry
from keyss.methods.base import MethodOptions, Opened
from keyss.runs.records import read_record

PathLike = str | Path
Background = Tensor | Sequence[float] | None
OptionsT = TypeVar("OptionsT", bound=MethodOptions)


@dataclass(frozen=True, kw_only=True)
class RunConfig(Generic[OptionsT]):
    """Of a hiding. Scenes are absolute paths of folders or models, None for what was in memory only."""

    version: int = 1
    keyss: str = __version__  # the program that wrote it
    method: str
    cover: str | None
    secrets: tuple[str | None, ...]
    models_given: tuple[bool, ...]  # of the cover, then of the secrets: a plain model, and not fitted
    width: int | None  # to which photos were shrunk
    background: tuple[float, float, float] | None  # where it was chosen
    skip_missing: bool = False  # whether photos that are not there were left out
    payloads: tuple[str, ...]  # `secret_ids` of the secrets
    options: OptionsT  # of the method


@dataclass(frozen=True, kw_only=True)
class FitRunConfig:
    """Of a plain fit."""

    version: int = 1
    keyss: str = __version__
    scene: str | None
    width: int | None
    background: tuple[float, float, float] | None
    skip_missing: bool = False
    config: FitConfig


def read_config(path: Path) -> RunConfig[MethodOptions]:
    """The configuration of a hiding, with the options of its method. Raises InputError."""
    # Fields that a class does not have are passed over: so every method's can be read as far as its name.
    name = read_record(path, RunConfig[MethodOptions]).method
    if name not in registry.METHODS:
        known = ", ".join(registry.METHODS)
        raise InputError(f"{path}: method {name!r} is not known; this program has {known}")
    generic: Any = RunConfig
    config: RunConfig[MethodOptions] = read_record(path, generic[registry.METHODS[name].options])
    if config.options.fit.seed is None:
        raise InputError(f"{path}: expected the seed of the run, got none")
    return config


def secret_ids(seed: int, opened: Iterable[Opened]) -> tuple[str, ...]:
    """By what a run of this seed knows its secrets; the same secret has another name in every run."""
    made_of = (f"keyss/v1/secret {seed} {each.fingerprint()}".encode() for each in opened)
    return tuple(hashlib.sha256(data).hexdigest()[:16] for data in made_of)


def path_of(source: PathLike | Scene | Gaussians) -> str | None:
    """Where a scene can be found again, None for one in memory."""
    return None if isinstance(source, Scene | Gaussians) else os.path.realpath(source)


def colour_of(background: Background) -> tuple[float, float, float] | None:
    """As it is written."""
    if background is None:
        return None
    red, green, blue = (float(x) for x in background)
    return red, green, blue
