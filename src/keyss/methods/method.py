"""The protocol of methods: hide secrets under keys in a published model, and open it with a key.

A method has a folder and an entry in `keyss.methods.registry`. Code outside the folder never tests for the
method's name, but for its capabilities.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeVar

from keyss.channels.names import ConvertedChannel, Format, Publish
from keyss.core.errors import KeyssWarning, UsageError
from keyss.fitting.config import FitConfig, preset_for

# Per Gaussian of the cover and of a secret (encoding, error correction), and per key.
_COVER_SECONDS, _KEY_SECONDS = 4e-6, 1.0
_SECRET_SECONDS = 5e-6, 3e-5  # channels of fixed size; growing ones, whose precision is searched
_FALLBACK = 'cannot hide this unchanged: {}; falling back to `publish="converted"`, which inspection finds'
T = TypeVar("T")

if TYPE_CHECKING:  # the command line reads options without torch
    import torch

    from keyss.channels import Channel, Payload
    from keyss.core.gaussians import Gaussians
    from keyss.core.scene import Scene
    from keyss.methods.hidden import HiddenScene
    from keyss.progress import Reporter


@dataclass(frozen=True)
class Source:
    """The cover or a secret, given as photos or a plain model; later it has both."""

    given: Gaussians | None  # plain 3DGS model on the CPU; None until it is fitted to the photos
    photos: bool  # False: renders of the model replace photos
    key: str = field(default="", repr=False)  # the secret's key, if the method has keys
    loaded: Scene | None = None
    steps: int | None = None  # training steps of the plain model, if known

    @property
    def scene(self) -> Scene:
        """Photos, or renders of the model."""
        if self.loaded is None:
            raise ValueError("the scene is not loaded yet")
        return self.loaded

    @property
    def model(self) -> Gaussians:
        """The plain model, in the scene's own frame, on the CPU."""
        if self.given is None:
            raise ValueError("the plain model is not fitted yet")
        return self.given


@dataclass(frozen=True)
class Training:
    """The method's own training of one scene, which its upper bound has to match."""

    steps: int = 0  # steps that render the scene
    continues: bool = True  # starts from the plain model, whose steps count too
    step_cost: float = 1.0  # time of a step over that of plain 3DGS

    def total(self, plain_steps: int | None) -> int | None:
        """All steps of the scene, those of its plain model included if they count; None: unknown."""
        if not self.continues:
            return self.steps
        return None if plain_steps is None else plain_steps + self.steps

    def keeps_bound(self, plain_steps: int | None) -> bool:
        """True if the plain model has as many steps, and is the upper bound itself."""
        return not self.steps if self.continues else self.steps == plain_steps


@dataclass(frozen=True)
class Context:
    """Where and how to compute."""

    device: torch.device
    checkpoints: Path | None = None  # folder for the state of interrupted trainings
    resume: bool = False
    reporter: Reporter | None = None
    # 32 secret bytes that seed all randomness: equal bytes give equal files. None: the system's randomness.
    entropy: bytes | None = field(default=None, repr=False)

    def loop_arguments(self, name: str) -> dict[str, Any]:
        """Arguments of `keyss.fitting.loop.train` that save a training under `name` and report it."""
        checkpoint = self.checkpoints / f"{name}.safetensors" if self.checkpoints else None
        return {"checkpoint": checkpoint, "resume": self.resume, "reporter": self.reporter}

    def waiting(self, what: str, seconds: float) -> AbstractContextManager[Any]:
        """See `Reporter.waiting`."""
        return self.reporter.waiting(what, seconds) if self.reporter else nullcontext()


@dataclass(frozen=True)
class Stego:
    """The result of hiding."""

    gaussians: Gaussians  # the published model
    opened: tuple[HiddenScene, ...]  # the secrets, opened with their keys
    iterations: int = 0  # joint training steps
    details: Mapping[str, Any] = field(default_factory=dict)  # the method's own numbers, for metrics.json
    verified: bool = False  # True if `opened` was read from `gaussians` with the keys
    companions: tuple[Payload, ...] = ()  # companion files, one per secret, if the method has any


@dataclass(frozen=True, kw_only=True)
class Capabilities:
    """The capabilities of a method."""

    keys: bool = True  # a key opens each secret; else a companion file of the model shows it
    standard: bool = True  # the published model is a 3DGS model, which every viewer renders


@dataclass(frozen=True)
class CommandLineOption:
    """Annotates a field of options that is a command-line option of the same name.

    A bool becomes a flag, everything else takes one value.
    """

    help: str
    metavar: str | None = None  # placeholder of the value in the help
    default: str | None = None  # the meaning of None
    parse: Callable[[str], Any] | None = None  # parses text, if the type does not


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """The options of every method; each method extends this class."""

    method: ClassVar[str]  # name in files and on the command line, 1 to 15 ASCII characters

    fit: FitConfig = field(default_factory=FitConfig)  # plain models, and joint training
    # "unchanged": the published model must stay as it is; "converted": it may be converted. None: "converted"
    # if the secrets do not fit into the cover unchanged, else "unchanged".
    publish: Publish | None = None
    format: Format | None = None  # format of an unchanged model; None: the cover's
    # Channel of a converted model: appended Gaussians hold 6 MB but are visible in the file; colours are less
    # visible and hold little.
    channel: ConvertedChannel = "appended"

    def __post_init__(self) -> None:
        """Raise UsageError for options that contradict each other."""
        if self.channel != "appended" and self.publish != "converted":
            raise UsageError(
                f'`channel="{self.channel}"` is for models that may be converted (`publish="converted"`)'
            )
        if self.format and self.publish == "converted":
            raise UsageError(f'`format="{self.format}"` is for models that stay unchanged: leave it out')

    @classmethod
    def preset(cls, size: str, device: str = "cpu") -> Self:
        """Options of one of the presets: see `keyss.fitting.config.preset_for`."""
        return cls(fit=preset_for(size, device))

    def in_channel(self, cover: Gaussians | None, use: Callable[[Channel], T]) -> T:
        """The result of `use` with the channel that these options select for `cover` (None: not fitted yet).

        If `use` raises UsageError, and neither `publish` nor `format` is given, falls back to appended
        Gaussians with a KeyssWarning.
        """
        from keyss.channels import APPENDED, channel_for

        channel = channel_for(self.publish or "unchanged", self.channel, self.format, cover)
        try:
            return use(channel)
        except UsageError as refusal:
            if channel is APPENDED:
                raise
            if self.publish or self.format:
                cure = '`channel="appended"`' if channel.survives else '`publish="converted"`'
                room = APPENDED.estimate_capacity(0, 0).bytes
                raise UsageError(f"{refusal}; {cure} has room for {room:,} bytes") from refusal
            warnings.warn(_FALLBACK.format(refusal), KeyssWarning, stacklevel=2)
        return use(APPENDED)

    def fits(self, scenes: int) -> list[FitConfig]:
        """The fits of the plain models of `scenes`, the cover first."""
        return [self.fit] * scenes

    def training(self, scenes: int) -> tuple[Training, ...]:
        """The method's own training of each of `scenes`, the cover first."""
        return (Training(),) * scenes

    @classmethod
    def variants(cls) -> Mapping[str, Self]:
        """Options of further variants for comparisons, by name."""
        return {}

    def with_fit(self, **changes: Any) -> Self:
        """Options with changed fields of `fit`."""
        return replace(self, fit=replace(self.fit, **changes))


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The size of a published model and of its secrets.

    Sizes are exact for given models, and upper limits for models that are not fitted yet.
    """

    gaussians: int  # Gaussians of the published model
    sh_degree: int  # SH degree of the published model
    secret_gaussians: int  # total over the secrets
    capacity: int  # Gaussians of the secrets that fit at their SH degree
    notes: tuple[str, ...] = ()  # sentences on the costs of options

    @property
    def megabytes(self) -> float:
        """Size of the published model as a .ply with normals; other formats take less."""
        return 4e-6 * self.gaussians * (14 + 3 * (self.sh_degree + 1) ** 2)

    @property
    def prunes(self) -> bool:
        """Whether secrets lose Gaussians."""
        return self.capacity < self.secret_gaussians

    @property
    def room(self) -> str:
        """What fits, as a phrase."""
        rough = "about " if self.prunes else ""
        more = "; of a lower SH degree, more fit" * self.prunes
        return f"room for {rough}{self.capacity:,} of the {self.secret_gaussians:,} Gaussians to hide{more}"


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A hiding that a method has checked, with everything that is decided before training."""

    options: Any  # as given; the method may complete `fit`
    fits: tuple[FitConfig, ...]  # fits of the plain models, the cover first
    training: tuple[Training, ...]  # the method's training of each scene, the cover first
    plan: Plan
    grows: bool = False  # the file grows with the secrets
    survives: bool = False  # the secrets survive conversion to other formats
    capacity: Any = None  # private to the method: the prepared cover, as large as the model

    @staticmethod
    def of(options: MethodOptions, scenes: int, plan: Plan) -> Prepared:
        """Training as the options say, for a method that publishes an unchanged model."""
        return Prepared(
            options=options,
            fits=tuple(options.fits(scenes)),
            training=options.training(scenes),
            plan=plan,
        )

    @property
    def trains(self) -> bool:
        """True if hiding trains after the plain models are fitted."""
        return any(training.steps for training in self.training)


class Method(Protocol):
    """One way to hide secrets."""

    name: str  # equal to `options.method`
    max_secrets: int  # maximum secrets per model
    capabilities: Capabilities
    options: type[MethodOptions]

    def prepare(self, sources: Sequence[Source], options: Any, earlier: Prepared | None = None) -> Prepared:
        """Check that the scenes, the cover first, can be hidden, and decide how.

        Called again once missing plain models are fitted: the training and the channel of the `earlier` call
        stay. Raises UsageError and InputError for what cannot work.
        """

    def hide(self, sources: list[Source], prepared: Prepared, context: Context) -> Stego:
        """Hide the secrets; all plain models are fitted, and the options have a seed.

        May empty `sources`, which frees the memory of models early. Raises KeyssError and its children,
        Interrupted.
        """


def divide(available: Sequence[int], total: int) -> list[int]:
    """Divide `total` items equally, with at most `available` [S] for each share; the others get the rest."""
    shares = [0] * len(available)
    left = total
    for done, index in enumerate(sorted(range(len(available)), key=lambda i: available[i])):
        shares[index] = min(available[index], left // (len(available) - done))
        left -= shares[index]
    return shares


def role_of(index: int, scenes: int) -> str:
    """The name of scene `index` of `scenes`. Scene 0 is the cover; a single secret has no number."""
    return "cover" if index == 0 else "secret" if scenes == 2 else f"secret {index}"


def role_phrase(role: str) -> str:
    """The name of a role in a sentence: "the secret", but "secret 2"."""
    return role if role[-1].isdigit() else f"the {role}"


def check_above_zero(options: object, *names: str) -> None:
    """Raise UsageError for an option that is not a finite number above 0."""
    for name in names:
        value = getattr(options, name)
        if not 0 < value < math.inf:
            raise UsageError(f"`{name}`: expected a number above 0, got {value}")


def seconds_to_hide(cover: int, secrets: Sequence[int], grows: bool) -> float:
    """About the seconds to hide models of so many Gaussians in a cover, without training, on two cores."""
    return _COVER_SECONDS * cover + _SECRET_SECONDS[grows] * sum(secrets) + _KEY_SECONDS * len(secrets)
