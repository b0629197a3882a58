"""What every method is: from scenes and keys to one published model, and from it and a key to a secret.

A method lives in a folder of its own and is entered once, in `keyss.methods.registry`. Nothing outside its
folder tests for its name: what it can do it declares, and what it finds it gives back as these types.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from keyss.channels.base import Content
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Reporter

Frame = Literal["secret", "cover"]


@dataclass(frozen=True)
class Capabilities:
    """What a method can do; the command line, the audit and tables read it instead of its name."""

    trains: bool  # hiding is a training of its own, after the plain models
    standard_file: bool  # what is published is an ordinary 3DGS model for every viewer
    most_secrets: int
    sidecar: bool  # can write what keys open to a file beside the model
    recommended_for: str  # one line for tables and help


@dataclass(frozen=True)
class Source:
    """One scene as a method gets it: pictures of it, and a plain 3DGS model."""

    scene: Scene  # photos, or pictures rendered of the model
    model: Gaussians  # in the scene's own frame, on the CPU
    model_given: bool  # and not fitted here


@dataclass(frozen=True)
class KeyedSource:
    """A secret and the key that is to open it."""

    source: Source
    key: str = field(repr=False)


@dataclass(frozen=True)
class Context:
    """Where and how to compute."""

    device: torch.device
    checkpoints: Path | None = None  # folder for the state of what is interrupted
    resume: bool = False
    reporter: Reporter | None = None


class Opened(Protocol):
    """A secret as its key opens it, before it is revealed."""

    @property
    def frame(self) -> Similarity | None:
        """From the secret's own frame into the cover's; None where it was never in the cover's."""

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        """From a stego model and an embedding [64] to what a decoder makes of them, in the cover's frame.

        None where keys condition no decoder, so that a wrong key shows nothing at all.
        """

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a model of its own; `force`: also from a model that was changed.

        Raises InputError for a model that it does not belong to.
        """

    def fingerprint(self) -> str:
        """16 hexadecimal digits by which a run knows its secrets; they say nothing without the secret."""


@dataclass(frozen=True)
class Stego:
    """What hiding gives."""

    gaussians: Gaussians  # to be published
    sidecar: bytes | None  # what keys open, where it is not in the model
    opened: tuple[Opened, ...]  # the secrets as they come out again with their keys
    seconds: float  # of hiding alone, without plain models
    details: Mapping[str, Any] = field(default_factory=dict)  # numbers of its own, for metrics.json


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """What every method can be told; each has a class of its own that adds to it."""

    fit: FitConfig = field(default_factory=FitConfig)  # of plain models, and of the method's own training


class Method(Protocol):
    """One way to hide secrets."""

    name: str  # in files and on the command line, 1 to 15 ASCII characters
    summary: str  # one line
    capabilities: Capabilities
    options: type[MethodOptions]
    presets: Mapping[str, Any]  # options by name; the first is the default

    def check(self, models: Sequence[Gaussians | None], options: Any, sidecar: bool) -> None:
        """Refuse before anything is trained what cannot work: `models` of the cover, then of the secrets,
        None for those that will be fitted. Raises UsageError and InputError.
        """

    def hide(self, cover: Source, secrets: Sequence[KeyedSource], options: Any, context: Context) -> Stego:
        """Hide the secrets. Raises KeyssError and its children, Interrupted on Ctrl-C."""

    def unpack(self, content: Content) -> Opened:
        """The secret that lies in what a channel gave. Raises InputError for damage."""

    def attacks(self, stego: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
        """What somebody without a key, who has read the source of this method, makes of a stego model.

        Models to be rendered in the cover's frame, by the name of the attack; for `keyss audit`.
        """
