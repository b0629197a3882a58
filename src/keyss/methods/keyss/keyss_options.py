"""The configuration of KeySS, with the paper's symbols and values, and its named designs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, cast, get_args

from msgspec import Meta

from keyss.core.errors import UsageError, did_you_mean
from keyss.keys.derivation import EMBEDDING_SIZE
from keyss.methods.method import CommandLineOption, MethodOptions, Plan, Training, check_above_zero

Attribute = Literal["op", "ro", "sc", "xyz", "sh"]  # opacity, rotation, scale, position, colour
Mask = tuple[Attribute, ...]  # the attributes where theta (equation 8) is 1
ATTRIBUTES: Mask = get_args(Attribute)
CHANNELS = {"op": 1, "ro": 4, "sc": 3, "xyz": 3}  # sh: three per coefficient

Width = Annotated[int, Meta(ge=1, le=4096)]  # bounds for untrusted files


def parse_mask(text: str) -> Mask:
    """The attributes in a text like `op,ro,sc`, in canonical order. Raises UsageError for unknown or none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    unknown = sorted(names - set(ATTRIBUTES))
    if unknown or not names:
        raise UsageError(
            f"mask {text!r}: expected some of {','.join(ATTRIBUTES)}, got {','.join(unknown) or 'none'}"
        )
    return tuple(name for name in ATTRIBUTES if name in names)


@dataclass(frozen=True, kw_only=True)
class DecoderShape:
    """Sizes of a decoder; appendix B: two layers for the common branch, two for each other."""

    mask: Mask = ATTRIBUTES  # theta
    hidden: tuple[Width, Width] = (64, 128)  # common branch; from the authors' program, the paper gives none
    branch: Width = 64  # branch of each attribute
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    key_size: Width = EMBEDDING_SIZE  # numbers of a key's vector
    # The authors' program instead of the paper's text: inputs, residuals, initial weights, training.
    released: bool = False

    @property
    def inputs(self) -> int:
        """Numbers that describe one Gaussian and a key."""
        return 11 + 3 * (self.sh_degree + 1) ** 2 + self.key_size

    def channels(self, attribute: str) -> int:
        return CHANNELS.get(attribute, 3 * (self.sh_degree + 1) ** 2)

    @property
    def weights(self) -> int:
        """Number of weights, without biases."""
        first, second = self.hidden
        branches = sum(self.branch * (second + self.channels(name)) for name in self.mask)
        return self.inputs * first + first * second + branches


Scenes = Literal["both", "cover", "secret"]  # "both": all scenes, also with several secrets


@dataclass(frozen=True, kw_only=True)
class Design:
    """Every choice of a joint training; the defaults are the paper's (sections 3.4 and 4.1, appendix B)."""

    name: str
    decoder: DecoderShape  # D of equations 3 and 6, with theta of equation 8
    # lambda_cover = lambda_secret = lambda_incorrect (equations 4, 5 and 7), also for plain models. None: use
    # the fit's weight.
    ssim_weight: float | None = 0.5
    beta_cover: float = 0.5  # equation 11
    beta_secret: float = 0.5  # for each secret
    beta_incorrect: float = 0.01  # 0: no wrong keys in training
    points: Scenes = "both"  # scenes whose sparse points start the model (combined SfM points)
    poses: Scenes = "both"  # scenes whose training poses are used (combined camera poses)
    densification: Scenes = "both"  # scenes whose gradients count (combined densification)
    # Share of the cap that the points fill at most. With more, density control would have no room (ours).
    start_share: float = 1 / 3
    # Share of the steps that render all scenes from one pose; the paper does not say. In the others each
    # has a photo of its own: renders from foreign poses, where no photo was taken, are poor targets.
    common_poses: float = 0.25
    # Rate of AdamW in runs of 30,000 steps. Shorter runs raise it as they raise the Gaussians' rates
    # (`keyss.fitting.schedule.boost_of`), and all runs let it decay to 5 %. The paper gives none.
    decoder_rate: float = 5e-4
    # Steps in which the decoder alone learns, without renders, from which scene each point is (ours); only
    # with the points of both scenes and a decoder of opacities. Without them, points of all scenes become
    # transparent in all of them, and transparent Gaussians have no gradient.
    pretraining: int = 400
    # First share of the run, in which this rate rises from 0 (ours). A fast decoder makes all points of a
    # secret with a plain background transparent, and transparent Gaussians have no gradient.
    warm_up: float = 0.1
    weight_decay: float = 1e-4  # from the authors' program

    def __post_init__(self) -> None:
        """Raise UsageError for values out of range."""
        check_above_zero(self, "beta_cover", "beta_secret", "decoder_rate")
        for name in ("common_poses", "beta_incorrect", "warm_up"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"`{name}`: expected 0 to 1, got {getattr(self, name)}")
        if self.pretraining < 0:
            raise UsageError(f"`pretraining`: expected at least 0 steps, got {self.pretraining}")
        if not 0 < self.start_share < 1:
            raise UsageError(f"`start_share`: expected above 0 and below 1, got {self.start_share}")


DesignName = Literal["published", "released"]

_PUBLISHED = Design(name="published", decoder=DecoderShape(mask=("op", "ro", "sc", "xyz")))
DESIGNS: dict[str, Design] = {
    # The paper's text.
    "published": _PUBLISHED,
    # The authors' program where it differs from the text or the text is silent; docs/keyss.md lists these.
    "released": replace(
        _PUBLISHED,
        name="released",
        ssim_weight=0.2,
        common_poses=1.0,
        decoder_rate=5e-5,
        warm_up=0.0,
        pretraining=0,
        decoder=replace(_PUBLISHED.decoder, released=True, branch=128),
    ),
}


def parse_design(text: str) -> DesignName:
    """The name of a design. Raises UsageError."""
    if text not in DESIGNS:
        raise UsageError(f"there is no design {text!r}; {did_you_mean(text, DESIGNS)}")
    return cast(DesignName, text)


@dataclass(frozen=True, kw_only=True)
class JointOptions(MethodOptions):
    """Options of a joint training of all scenes, which share the Gaussians of one model."""

    def __post_init__(self) -> None:
        """Raise UsageError if the model would be published in a lossy format."""
        super().__post_init__()
        if self.publish == "converted" or self.format not in (None, "ply"):
            option = 'publish="converted"' if self.publish == "converted" else f'format="{self.format}"'
            raise UsageError(
                f"`{option}`: this method needs the published model bit for bit: leave it out, or use "
                '`method="carry"`'
            )

    @property
    def configuration(self) -> Design:
        """The complete design. Raises UsageError for values out of range."""
        raise NotImplementedError

    @property
    def step_cost(self) -> float:
        """Time of a training step over that of plain 3DGS of all scenes."""
        return 1.0

    def training(self, scenes: int) -> tuple[Training, ...]:
        """Every step renders all scenes."""
        return (Training(self.fit.iterations, continues=False, step_cost=self.step_cost),) * scenes

    def joint_plan(self, secrets: int) -> Plan:
        """The plan of the training, whose model has the size of one plain model."""
        fit = self.fit
        return Plan(
            gaussians=fit.max_gaussians,
            sh_degree=fit.sh_degree,
            secret_gaussians=secrets * fit.max_gaussians,
            capacity=fit.max_gaussians,
        )


@dataclass(frozen=True, kw_only=True)
class KeyssOptions(JointOptions):
    """A design, and how keys become vectors; `fit` has the training's length, size and rates of Gaussians."""

    method: ClassVar[str] = "keyss"

    design: Annotated[
        Design | DesignName,
        CommandLineOption(
            "published: the paper's text; released: the authors' program.",
            metavar="{published,released}",
            default="published",
            parse=parse_design,
        ),
    ] = "published"
    mask: Annotated[
        Mask | None,
        CommandLineOption(
            "Attributes that the decoder may change (theta), comma-separated.",
            metavar="op,ro,sc,xyz,sh",
            default="the design's",
            parse=parse_mask,
        ),
    ] = None
    key_encoder: Annotated[
        Literal["argon2", "clip"],
        CommandLineOption("Turns keys into vectors for the decoder; encryption always uses Argon2id."),
    ] = "argon2"
    clip_model: Annotated[
        str | None,
        CommandLineOption("CLIP for --key-encoder clip.", metavar="FOLDER", default="ViT-L/14 in the cache"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.configuration  # raises for an unknown design
        if self.clip_model is not None and self.key_encoder != "clip":
            raise UsageError('`clip_model` needs `key_encoder="clip"`')

    @property
    def configuration(self) -> Design:
        """The complete design, with the given mask. Raises UsageError for an unknown name."""
        design = self.design
        if isinstance(design, str):
            design = DESIGNS[parse_design(design)]
        if self.mask is None:
            return design
        return replace(design, decoder=replace(design.decoder, mask=parse_mask(",".join(self.mask))))

    @property
    def step_cost(self) -> float:
        """Measured at 9,000 Gaussians and 120 pixels: 5.4 to 8.0."""
        return 6.5
