"""The folder of a hiding, opened with its keys for evaluation and audits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.files.models import read_model
from keyss.methods import registry
from keyss.methods.hidden import HiddenScene
from keyss.methods.method import MethodOptions
from keyss.rendering.orbit import is_model
from keyss.runs.files import (
    CONFIG,
    METRICS,
    PathLike,
    as_scene,
    bound_names,
    companion_names,
    plain_names,
    run_folder,
    stego_in,
)
from keyss.runs.json_records import read_record
from keyss.runs.revealing import read_companion
from keyss.runs.run_records import HideMetrics, RunConfig, read_config, secret_ids


@dataclass(frozen=True)
class HidingRun:
    """The published model of a run, its secrets, and its sources."""

    folder: Path
    config: RunConfig[MethodOptions]
    metrics: HideMetrics
    stego: Gaussians
    opened: tuple[HiddenScene, ...]  # one per secret, in order
    keys: tuple[str, ...] = field(repr=False)  # one per secret; "" if the method has no keys
    sources: tuple[str, ...]  # cover, then secrets: scene folders, or models without photos

    @property
    def openers(self) -> list[Callable[[Gaussians], HiddenScene]]:
        """Functions that open the secrets in a changed model; companion files do not change."""
        if registry.get(self.config.method).capabilities.keys:
            return [lambda stego, key=key: registry.open_model(stego, key) for key in self.keys]  # type: ignore[misc]
        return [lambda _, secret=secret: secret for secret in self.opened]  # type: ignore[misc]

    def scenes(self, *, train_pictures: bool = True) -> list[Scene]:
        """The cover and the secrets with their photos, or with renders of given models."""
        return [as_scene(source, self.config.views, train_pictures=train_pictures) for source in self.sources]

    def plain_models(self) -> list[Gaussians | None]:
        """Plain models of the cover and of the secrets, in their own frames, if there are any."""
        models: list[Gaussians | None] = []
        for name, source in zip(plain_names(len(self.opened)), self.sources, strict=True):
            path = self.folder / name
            path = Path(source) if not path.exists() and is_model(source) else path
            models.append(read_model(path) if path.exists() else None)
        return models

    def baselines(self) -> list[Gaussians | None]:
        """Models to compare with: upper bounds, which were trained for longer, else `plain_models`."""
        bounds = [self.folder / name for name in bound_names(len(self.opened))]
        return [
            read_model(bound) if bound.exists() else plain
            for bound, plain in zip(bounds, self.plain_models(), strict=True)
        ]


def read_run(run: Path) -> tuple[Path, RunConfig[MethodOptions], HideMetrics, tuple[str, ...]]:
    """The folder of a hiding, its records, and its sources: the cover, then the secrets; needs no keys.

    Raises UsageError if the scenes were in memory, InputError for other folders.
    """
    folder = run_folder(run)
    config, metrics = read_config(folder / CONFIG), read_record(folder / METRICS, HideMetrics)
    sources = tuple(source for source in (config.cover, *config.secrets) if source is not None)
    if len(sources) <= len(config.secrets):
        raise UsageError(f"{folder} was made from scenes in memory: there are no photos to evaluate against")
    return folder, config, metrics, sources


def open_run(run: PathLike, keys: Sequence[str]) -> HidingRun:
    """Open a folder of `hide` with the keys of all its secrets, in any order.

    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key and for a run
    whose scenes were in memory, InputError for other folders.
    """
    folder, config, metrics, sources = read_run(Path(run))
    stego = read_model(stego_in(folder))
    if registry.get(config.method).capabilities.keys:
        opened = [registry.open_model(stego, key) for key in keys]
    elif keys:
        raise UsageError(f"the method {config.method} has no keys: give none")
    else:
        keys = [""] * len(config.payloads)
        opened = [read_companion(folder / name) for name in companion_names(len(keys))]
    names = secret_ids(config.options.fit.known_seed, opened)
    by_name = dict(zip(names, zip(opened, keys, strict=False), strict=True))
    if set(by_name) != set(config.payloads):
        raise UsageError(
            f"expected the keys of all {len(config.payloads)} secret(s), got {len(by_name)} of them"
        )
    secrets, ordered = zip(*(by_name[name] for name in config.payloads), strict=True)
    return HidingRun(folder, config, metrics, stego, secrets, ordered, sources)
