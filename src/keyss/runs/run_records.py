"""`config.json` and `metrics.json`: the arguments of a run, to load its scenes again, and its results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from keyss._version import __version__
from keyss.core.errors import InputError
from keyss.core.scene import ViewOptions
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import ImageQuality
from keyss.measure.hide_quality import BaselineQuality, RenderFidelity, WrongKeys
from keyss.methods import registry
from keyss.methods.hidden import HiddenScene
from keyss.methods.method import MethodOptions
from keyss.runs.folder import read_manifest
from keyss.runs.json_records import read_record

OptionsT = TypeVar("OptionsT", bound=MethodOptions)


@dataclass(frozen=True, kw_only=True)
class RunConfig(Generic[OptionsT]):
    """Arguments of a hiding. Scenes are absolute paths of folders or models, None for scenes in memory."""

    version: int = 1
    keyss: str = __version__  # the program that wrote it
    method: str
    cover: str | None
    secrets: tuple[str | None, ...]
    models_given: tuple[bool, ...]  # cover, then secrets; False: the plain model is fitted
    views: ViewOptions
    payloads: tuple[str, ...]  # `secret_ids` of the secrets
    options: OptionsT  # options of the method


@dataclass(frozen=True, kw_only=True)
class FitRunConfig:
    """Arguments of a plain fit."""

    version: int = 1
    keyss: str = __version__
    scene: str | None
    views: ViewOptions
    config: FitConfig


def with_seed(config: FitConfig, interrupted: Path | None, *names: str) -> FitConfig:
    """`config` with a seed: its own, that of the `interrupted` run, or a random one.

    `interrupted`: the run's folder; `names`: the path to its config among its arguments.
    """
    running = None if interrupted is None else read_manifest(interrupted).running
    value: Any = running and running.arguments
    for name in (*names, "seed"):
        value = value.get(name) if isinstance(value, dict) else None
    return config.with_seed(value if isinstance(value, int) else None)


def read_config(path: Path) -> RunConfig[MethodOptions]:
    """The configuration of a hiding, with the options of its method. Raises InputError."""
    # Unknown fields are ignored, so this reads the name for every method.
    name = read_record(path, RunConfig[MethodOptions]).method
    if name not in registry.METHODS:
        raise InputError(f"{path}: method {name!r}: expected one of {', '.join(registry.METHODS)}")
    generic: Any = RunConfig
    config: RunConfig[MethodOptions] = read_record(path, generic[registry.get(name).options])
    if config.options.fit.seed is None:
        raise InputError(f"{path}: expected the seed of the run, got none")
    return config


def secret_ids(seed: int, opened: Iterable[HiddenScene]) -> tuple[str, ...]:
    """Identifiers of the secrets; the same secret has another identifier in a run with another seed."""
    texts = (f"keyss/v1/secret {seed} {secret.fingerprint()}" for secret in opened)
    return tuple(hashlib.sha256(text.encode()).hexdigest()[:16] for text in texts)


@dataclass(frozen=True, kw_only=True)
class HideMetrics:
    """Results of a hiding: PSNRs in dB and SSIMs on test views, measured through the written files."""

    version: int = 1
    keyss: str = __version__  # the program that wrote it
    method: str
    cover: ImageQuality
    secrets: tuple[ImageQuality, ...]
    baseline: BaselineQuality
    wrong_key: WrongKeys | None  # None for methods without a keyed decoder
    chance_level: tuple[float, ...]  # dB, the stego model itself against each secret's test views
    gaussians: int  # Gaussians of the stego model
    photos: tuple[bool, ...]  # cover, then secrets; False: test views are renders of a given model
    secret_gaussians: tuple[int, ...]  # Gaussians of each revealed secret
    secret_degrees: tuple[tuple[int, int], ...]  # SH degrees of each secret and of its plain model
    iterations: int  # joint training steps; 0 if the method does not train
    # Total training steps of the cover and of each secret; None: unknown, the plain model was given.
    steps: tuple[int | None, ...]
    seconds: float  # total, interrupted parts included
    width: int  # pixels of the cover's test views
    seed: int
    against_plain: tuple[RenderFidelity, ...]  # cover, then secrets, read from the written files
    details: Mapping[str, Any] = field(default_factory=dict)  # further numbers of the method


@dataclass(frozen=True, kw_only=True)
class FitMetrics(ImageQuality):
    """Results of a plain fit on the test views."""

    version: int = 1
    keyss: str = __version__
    gaussians: int
    iterations: int
    seconds: float  # total, interrupted parts included
    width: int  # pixels of the photos
    seed: int
