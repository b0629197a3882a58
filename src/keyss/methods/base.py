"""What every method is: from scenes and keys to one published model, and from it and a key to a secret.

A method lives in a folder of its own and is entered once, in `keyss.methods.registry`. Nothing outside its
folder tests for its name: what it can do it declares, and what it finds it gives back as these types.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import torch

from keyss.channels import AnyChannel, Channel, Payload, Publish, channel_for
from keyss.core.errors import KeyssError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import PRESETS, FitConfig
from keyss.fitting.reporting import Reporter
from keyss.methods.opened import Opened
from keyss.methods.plan import Plan


@dataclass(frozen=True)
class Source:
    """The cover or a secret: what is given of it, and later its pictures and its plain model."""

    given: Gaussians | None  # a plain 3DGS model on the CPU; None: one is fitted to the photos
    photos: bool  # False: only the model is given, and renders of it take the place of photos
    key: str = field(default="", repr=False)  # of a secret, where the method has keys
    loaded: Scene | None = None
    fitted: Gaussians | None = None

    @property
    def scene(self) -> Scene:
        """Photos, or renders of the model."""
        if self.loaded is None:
            raise ValueError("the scene is not loaded yet")
        return self.loaded

    @property
    def model(self) -> Gaussians:
        """The plain model, in the scene's own frame, on the CPU."""
        found = self.fitted if self.given is None else self.given
        if found is None:
            raise ValueError("the plain model is not fitted yet")
        return found


@dataclass(frozen=True)
class Training:
    """What a method's own training is for one scene: what makes a plain model of it comparable."""

    steps: int = 0  # in which it is drawn
    continues: bool = True  # from its plain model, whose steps count too


@dataclass(frozen=True)
class Context:
    """Where and how to compute."""

    device: torch.device
    checkpoints: Path | None = None  # folder for the state of what is interrupted
    resume: bool = False
    reporter: Reporter | None = None
    # 32 bytes that nobody else can know, for a run that is to be repeated to the byte; None: the system's.
    entropy: bytes | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Stego:
    """What hiding gives."""

    gaussians: Gaussians  # to be published
    opened: tuple[Opened, ...]  # the secrets as they come out again with their keys
    iterations: int = 0  # of the method's own training
    details: Mapping[str, Any] = field(default_factory=dict)  # numbers of its own, for metrics.json
    verified: bool = False  # whether `opened` was read from `gaussians` with the keys
    handed: tuple[Payload, ...] = ()  # for each secret what is handed over, where the method does that


@dataclass(frozen=True, kw_only=True)
class Capabilities:
    """What a method can do; what it cannot is said where it is asked for, and in comparisons."""

    keys: bool = True  # a key opens each secret; else whoever has what is handed over sees it
    hands_over: bool = False  # there is a file for each secret beside the published model
    standard: bool = True  # what is published is a 3DGS model, which every viewer draws
    models: bool = True  # and so is what a secret is revealed as; else a network makes its pictures


@dataclass(frozen=True)
class CommandLineOption:
    """Annotates a field of options that the command line has too, under the same name.

    A truth value becomes a flag, everything else takes one value.
    """

    help: str
    metavar: str | None = None  # stands for the value in the help
    default: str | None = None  # what None stands for
    parse: Callable[[str], Any] | None = None  # makes the value of text, where the type does not


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """What every method can be told; each has a class of its own that adds to it."""

    method: ClassVar[str]  # its name in files and on the command line, 1 to 15 ASCII characters

    fit: FitConfig = field(default_factory=FitConfig)  # of plain models, and of the method's own training
    publish: Publish = "ply"  # format that the published model is passed on in; any: it may be converted
    # Of models that may be converted: appended Gaussians hold everything, and everybody can see that they are
    # there; colours hold little and show less.
    channel: AnyChannel = "appended"

    def __post_init__(self) -> None:
        """Raise UsageError for what does not go together."""
        if self.channel != "appended" and self.publish != "any":
            raise UsageError(
                f'`channel="{self.channel}"` is for models that may be converted (`publish="any"`)'
            )

    @classmethod
    def preset(cls, size: str) -> Self:
        """Options of one of the sizes in `keyss.fitting.config.PRESETS`. Raises UsageError."""
        if size not in PRESETS:
            raise UsageError(f"preset {size!r}: expected {' or '.join(PRESETS)}")
        return cls(fit=PRESETS[size])

    @property
    def place(self) -> Channel:
        """The channel that secrets lie in."""
        return channel_for(self.publish, self.channel)

    @property
    def trains(self) -> bool:
        """Whether hiding is a training of its own, after the plain models; prepared."""
        return any(each.steps for each in self.training(2))

    @property
    def may_train(self) -> bool:
        """Whether steps may count when models of all scenes are given; known before scenes are."""
        return self.trains

    def fits(self, scenes: int) -> list[FitConfig]:
        """How plain models of the cover and of each secret are fitted; of `scenes` together, prepared."""
        return [self.fit] * scenes

    def training(self, scenes: int) -> tuple[Training, ...]:
        """The method's own training of the cover and of each secret; of `scenes` together, prepared."""
        return (Training(),) * scenes

    @classmethod
    def variants(cls) -> Mapping[str, Self]:
        """Other kinds of the method, by name, that a comparison lists beside it."""
        return {}

    def with_fit(self, **changes: Any) -> Self:
        """The same with changed fields of `fit`."""
        return replace(self, fit=replace(self.fit, **changes))


class Method(Protocol):
    """One way to hide secrets."""

    @property
    def name(self) -> str:
        """That of its options."""

    @property
    def summary(self) -> str:
        """One line that goes on from the name."""

    @property
    def most_secrets(self) -> int:
        """How many secrets one model can have."""

    @property
    def capabilities(self) -> Capabilities:
        """What it can and cannot do."""

    @property
    def options(self) -> type[MethodOptions]:
        """The class of its options."""

    def prepare(self, sources: Sequence[Source], options: Any) -> Any:
        """The options with all that depends on the scenes: the cover, then the secrets.

        Refuses what cannot work, before anything is trained. Raises UsageError and InputError.
        """

    def plan(self, sources: Sequence[Source], options: Any) -> Plan:
        """What will come of it, as far as a method knows; `options` are prepared."""

    def hide(self, cover: Source, secrets: Sequence[Source], options: Any, context: Context) -> Stego:
        """Hide the secrets; `options` are prepared and have a seed.

        Raises KeyssError and its children, Interrupted.
        """


def role_of(index: int, scenes: int) -> str:
    """What scene `index` of so many is called: the cover comes first, and a single secret has no number."""
    return "cover" if index == 0 else "secret" if scenes == 2 else f"secret {index}"


def check_above_zero(options: object, *names: str) -> None:
    """Raise UsageError for an option that is not a number above 0: what is divided by it would be none."""
    for name in names:
        value = getattr(options, name)
        if not 0 < value < math.inf:
            raise UsageError(f"`{name}`: expected a number above 0, got {value}")


@contextmanager
def advising(kind: type[KeyssError], advice: str) -> Iterator[None]:
    """Adds to the message of an error from below, such as a channel's, what a user of the method can do."""
    try:
        yield
    except kind as error:
        raise type(error)(f"{error}; {advice}") from error
