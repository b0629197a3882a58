"""`config.json`: the arguments of a run, from which later commands load its scenes again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from keyss._version import __version__
from keyss.core.errors import InputError
from keyss.core.scene import ViewOptions
from keyss.fitting.config import FitConfig
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.methods.opened import Opened
from keyss.runs.records import read_record

OptionsT = TypeVar("OptionsT", bound=MethodOptions)


@dataclass(frozen=True, kw_only=True)
class RunConfig(Generic[OptionsT]):
    """Arguments of a hiding. Scenes are absolute paths of folders or models, None for scenes in memory."""

    version: int = 1
    keyss: str = __version__  # the program that wrote it
    method: str
    cover: str | None
    secrets: tuple[str | None, ...]
    models_given: tuple[bool, ...]  # of the cover and the secrets; False: the plain model is fitted
    views: ViewOptions
    payloads: tuple[str, ...]  # `secret_ids` of the secrets
    options: OptionsT  # of the method


@dataclass(frozen=True, kw_only=True)
class FitRunConfig:
    """Arguments of a plain fit."""

    version: int = 1
    keyss: str = __version__
    scene: str | None
    views: ViewOptions
    config: FitConfig


def read_config(path: Path) -> RunConfig[MethodOptions]:
    """The configuration of a hiding, with the options of its method. Raises InputError."""
    # Unknown fields are skipped, so the name can be read whatever the method.
    name = read_record(path, RunConfig[MethodOptions]).method
    if name not in registry.METHODS:
        raise InputError(f"{path}: method {name!r}: expected one of {', '.join(registry.METHODS)}")
    generic: Any = RunConfig
    config: RunConfig[MethodOptions] = read_record(path, generic[registry.get(name).options])
    if config.options.fit.seed is None:
        raise InputError(f"{path}: expected the seed of the run, got none")
    return config


def secret_ids(seed: int, opened: Iterable[Opened]) -> tuple[str, ...]:
    """Names of the secrets in a run of this seed; the same secret has another name in every run."""
    texts = (f"keyss/v1/secret {seed} {secret.fingerprint()}" for secret in opened)
    return tuple(hashlib.sha256(text.encode()).hexdigest()[:16] for text in texts)
