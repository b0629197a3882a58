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
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor

from keyss.channels.base import Content, Payload
from keyss.channels.rooms import AnyChannel, Publish
from keyss.core.decoded import PictureNetwork
from keyss.core.errors import KeyssError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Reporter

Frame = Literal["secret", "cover"]


@dataclass(frozen=True)
class SceneInput:
    """What is known of a scene before anything is rendered or trained."""

    model: Gaussians | None  # a plain model on the CPU; None: one will be fitted to the photos
    photos: bool  # False: the model is all there is, and pictures of it take the place of photos


@dataclass(frozen=True)
class Training:
    """What a method's own training is for one scene: what makes a plain model of it comparable."""

    steps: int = 0  # in which it is drawn
    goes_on: bool = True  # from its plain model, so that the steps of that one count too


@dataclass(frozen=True)
class Outlook:
    """What is known of a hiding before it begins: of given models exactly, else as much as is allowed."""

    gaussians: int  # of the published model, at most
    sh_degree: int  # of the published model
    asked: int  # Gaussians that the secrets have together, at most
    capacity: int  # of these, how many fit
    steps: int = 0  # of the method's own training
    drawn: tuple[int, ...] = ()  # Gaussians of the cover and of each secret that a step of it draws
    notes: tuple[str, ...] = ()  # what the options cost, a sentence each
    # By way of which pictures of the cover and of each secret are made, untrained; () where there are none.
    networks: tuple[PictureNetwork | None, ...] = ()
    # What all Gaussians go through in a step of it, None where they are drawn as they are; and how often.
    decode: Callable[[Gaussians], Gaussians] | None = None
    decodings: float = 0.0


@dataclass(frozen=True)
class Source:
    """One scene as a method gets it: pictures of it, and a plain 3DGS model."""

    scene: Scene  # photos, or pictures rendered of the model
    model: Gaussians  # in the scene's own frame, on the CPU


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
    # 32 bytes that nobody else can know, for a run that is to be repeated to the byte; None: the system's.
    entropy: bytes | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Remains:
    """How much of a secret a model still gives."""

    found: int  # Gaussians
    hidden: int  # Gaussians that there were; 0: not known
    chunks: tuple[int, int] | None = None  # of its payload: those left and those there were; None: no chunks
    slack: float = 0.0  # share by which the numbers may differ although nothing was lost

    @property
    def share(self) -> float:
        """Of the hidden Gaussians those found: 0 to 1, more where Gaussians were added."""
        return self.found / self.hidden if self.hidden else float(self.found > 0)

    @property
    def whole(self) -> bool:
        """Whether nothing was lost or added."""
        return abs(self.share - 1) <= self.slack and (self.chunks is None or self.chunks[0] == self.chunks[1])


class Opened(Protocol):
    """A secret as its key opens it, before it is revealed."""

    @property
    def frame(self) -> Similarity | None:
        """From the secret's own frame into the cover's; None where it was never in the cover's."""

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        """From a stego model and an embedding [64] to what a decoder makes of them, in the cover's frame.

        Differentiable in the embedding where the decoder is: the white-box attack goes by that gradient. None
        where keys condition no decoder, so that a wrong key shows nothing at all.
        """

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a model of its own, on the CPU; `force`: also from a model that was changed.

        Raises InputError for a model that it does not belong to, UsageError for a frame that it never was in.
        """

    def remains(self, revealed: Gaussians) -> Remains:
        """How much of the secret there is in what `reveal` gave."""

    def fingerprint(self) -> str:
        """16 hexadecimal digits by which a run knows its secrets; they say nothing without the secret."""


@dataclass(frozen=True)
class Stego:
    """What hiding gives."""

    gaussians: Gaussians  # to be published
    opened: tuple[Opened, ...]  # the secrets as they come out again with their keys
    seconds: float  # of hiding alone, without plain models
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
    alias: str | None = None  # another name
    parse: Callable[[str], Any] | None = None  # makes the value of text, where the type does not


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """What every method can be told; each has a class of its own that adds to it."""

    fit: FitConfig = field(default_factory=FitConfig)  # of plain models, and of the method's own training
    publish: Publish = "ply"  # format that the published model is passed on in; any: it may be converted
    # Of models that may be converted: appended Gaussians hold everything, and everybody can see that they are
    # there; colours hold little and show less.
    channel: AnyChannel = "appended"
    repair: bool = False  # colours: a short fit of the harmonics afterwards, so that views look as before

    def __post_init__(self) -> None:
        """Raise UsageError for what does not go together."""
        if self.channel != "appended" and self.publish != "any":
            raise UsageError(
                f'`channel="{self.channel}"` is for models that may be converted (`publish="any"`)'
            )
        if self.repair and self.channel != "colours":
            raise UsageError('`repair` is for what is written into colours (`channel="colours"`)')

    def training(self, scenes: int) -> tuple[Training, ...]:
        """The method's own training of the cover and of each secret; of `scenes` together, prepared."""
        return (Training(),) * scenes

    def with_fit(self, **changes: Any) -> Self:
        """The same with changed fields of `fit`."""
        return replace(self, fit=replace(self.fit, **changes))

    def adapted(self, **changes: Any) -> Self:
        """The same with changed fields, and with what follows from them."""
        return replace(self, **changes)


class Method(Protocol):
    """One way to hide secrets."""

    @property
    def name(self) -> str:
        """In files and on the command line, 1 to 15 ASCII characters."""

    @property
    def summary(self) -> str:
        """One line that goes on from the name."""

    @property
    def trains(self) -> bool:
        """Whether hiding is a training of its own, after the plain models."""

    @property
    def most_secrets(self) -> int:
        """How many secrets one model can have."""

    @property
    def capabilities(self) -> Capabilities:
        """What it can and cannot do."""

    @property
    def options(self) -> type[MethodOptions]:
        """The class of its options."""

    @property
    def presets(self) -> Mapping[str, MethodOptions]:
        """Options by name; the first are the default."""

    def prepare(self, inputs: Sequence[SceneInput], options: Any) -> Any:
        """The options with all that depends on the scenes: `inputs` of the cover, then of the secrets.

        Refuses what cannot work, before anything is trained. Raises UsageError and InputError.
        """

    def outlook(self, inputs: Sequence[SceneInput], options: Any) -> Outlook:
        """What will come of it; `options` are prepared."""

    def hide(self, cover: Source, secrets: Sequence[KeyedSource], options: Any, context: Context) -> Stego:
        """Hide the secrets; `options` are prepared and have a seed.

        Raises KeyssError and its children, Interrupted.
        """

    def unpack(self, content: Content) -> Opened:
        """The secret in what a channel gave or what was handed over. Raises InputError for damage."""


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
