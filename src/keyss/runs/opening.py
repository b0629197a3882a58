"""A folder that `hide` made, opened with its keys: what evaluating and auditing start from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.scene import Scene
from keyss.files.models import read_model
from keyss.files.scenes import load_scene
from keyss.methods.carry.carrying import Carried
from keyss.methods.learned.opening import open_model
from keyss.methods.learned.payload import HiddenSecret, pack_secret
from keyss.methods.learned.revealing import Frame, open_secret, read_sidecar, reveal_gaussians
from keyss.rendering.orbit import is_model, scene_of_model
from keyss.runs.files import CONFIG, METRICS, SIDECAR, STEGO, plain_names, read_json

PathLike = str | Path
Background = Tensor | Sequence[float] | None
Opened = HiddenSecret | Carried


@dataclass(frozen=True)
class HidingRun:
    """What a run published, what its keys open in it, and from what it was made."""

    folder: Path
    settings: dict[str, Any]  # config.json
    metrics: dict[str, Any]  # metrics.json
    stego: Gaussians
    sidecar: Path | None
    opened: tuple[Opened, ...]  # in the order of the secrets
    keys: tuple[str, ...] = field(repr=False)  # in the same order
    sources: tuple[str, ...]  # of the cover, then of the secrets: scene folders, or models without photos

    @property
    def method(self) -> str:
        """ "learned" or "carry"."""
        return str(self.settings.get("method", "learned"))

    @property
    def width(self) -> int | None:
        """To which photos were shrunk."""
        width: int | None = self.settings["width"]
        return width

    @property
    def background(self) -> list[float] | None:
        """Behind everything, where it was chosen."""
        colour: list[float] | None = self.settings["background"]
        return colour

    def scenes(self) -> list[Scene]:
        """The cover and the secrets with their photos, or with pictures of the models that they are."""
        return [as_scene(source, self.width, self.background) for source in self.sources]

    def plain_models(self) -> list[Gaussians | None]:
        """Plain models of the cover and of the secrets, in their own frames; None where there is none."""
        found: list[Gaussians | None] = []
        for name, source in zip(plain_names(len(self.opened)), self.sources, strict=True):
            path = self.folder / name
            path = Path(source) if not path.exists() and is_model(source) else path
            found.append(read_model(path) if path.exists() else None)
        return found


def open_run(run: PathLike, keys: Sequence[str]) -> HidingRun:
    """A folder that `hide` made, with what `keys` open in it: those of all its secrets, in any order.

    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key and for a run on
    scenes that were in memory only, InputError for a folder that is not one of `hide`.
    """
    folder = Path(run)
    settings, metrics = read_json(folder / CONFIG), read_json(folder / METRICS)
    try:
        sources = (settings["cover"], *settings["secrets"])
        fingerprints = list(settings["payloads"])
        settings["width"], settings["background"]
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{folder / CONFIG}: not the configuration of a hiding ({error} is missing)"
        ) from error
    if not all(isinstance(source, str) for source in sources):
        raise UsageError(f"{folder} was made from scenes in memory: there are no photos to evaluate against")
    stego, sidecar = read_model(folder / STEGO), sidecar_beside(folder / STEGO)
    found = {fingerprint(secret): (secret, key) for key in keys for secret in [open_any(stego, key, sidecar)]}
    if set(found) != set(fingerprints):
        raise UsageError(f"expected the keys of all {len(fingerprints)} secret(s), got {len(found)} of them")
    opened, own = zip(*(found[each] for each in fingerprints), strict=True)
    return HidingRun(folder, settings, metrics, stego, sidecar, opened, own, sources)


def open_any(stego: Gaussians, key: str, sidecar: PathLike | bytes | None, *, decoy: bool = False) -> Opened:
    """What the key opens, of either method; see `open_model`. Errors name the sidecar's file."""
    if sidecar is None:
        return open_model(stego, key, decoy=decoy)
    if isinstance(sidecar, bytes):
        return open_secret(stego, key, sidecar, decoy=decoy)
    try:
        return open_secret(stego, key, read_sidecar(Path(sidecar)), decoy=decoy)
    except InputError as error:
        raise InputError(f"{sidecar}: {error}") from error


def revealed(stego: Gaussians, secret: Opened, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
    """The secret as a model of its own, on the CPU; a carried one makes up for what was lost."""
    if isinstance(secret, Carried):
        return compensate_pruning(secret.gaussians, secret.count)
    return reveal_gaussians(stego, secret, frame=frame, force=force).to("cpu")


def as_scene(source: PathLike | Scene | Gaussians, width: int | None, background: Background) -> Scene:
    """A scene, the photos in a folder, or what a model or the one in a `.ply` shows from all around."""
    if isinstance(source, Scene):
        return source
    if not isinstance(source, Gaussians) and not is_model(source):
        return load_scene(source, width=width, background=background)
    name = "model" if isinstance(source, Gaussians) else Path(source).stem
    colour = None if background is None else torch.as_tensor(background, dtype=torch.float32)
    return scene_of_model(as_model(source), name, size=width, background=colour)


def as_model(source: PathLike | Gaussians) -> Gaussians:
    """A model, or the one in a `.ply`, on the CPU."""
    return source.to("cpu") if isinstance(source, Gaussians) else read_model(source)


def sidecar_beside(stego: Path) -> Path | None:
    """The sealed decoder beside a model's file, if there is one."""
    path = stego.with_name(SIDECAR)
    return path if path.exists() else None


def fingerprint(secret: Opened) -> str:
    """By which `open_run` knows whose key it was given; says nothing without the secret."""
    if isinstance(secret, Carried):
        return secret.fingerprint()
    return hashlib.sha256(pack_secret(secret)).hexdigest()[:16]
