"""The options of KeySS, with the paper's names where it has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, ClassVar, Literal

from keyss.core.errors import UsageError
from keyss.fitting.config import FitConfig
from keyss.methods.base import CommandLineOption, check_above_zero
from keyss.methods.joint_options import JointOptions
from keyss.methods.keyss.decoder import DecoderShape, Mask, parse_mask

DesignName = Literal["mlp", "published", "released"]


@dataclass(frozen=True, kw_only=True)
class Design:
    """Everything that a design sets, and that an option of the same name overrides."""

    # The decoder, see `DecoderShape`.
    mask: Mask = ("op",)
    conditioning: Literal["gate", "bias"] = "gate"
    hidden: tuple[int, int] = (64, 64)
    branch: int = 32
    frequencies: int = 6
    inputs: Literal["standardised", "normalised"] = "standardised"
    residuals: Literal["signed", "one-sided"] = "signed"
    decoder_rate: float = 1e-3  # of AdamW, decays to 5 % of it
    # Share of the steps that render all scenes from one pose, against a photo or the plain model's render. In
    # the others each scene has a pose and a photo of its own.
    common_poses: float = 0.1
    incorrect_weight: float = 0.05  # beta_incorrect: wrong keys against the cover; a gate needs none
    incorrect_every: int = 4  # steps between two wrong keys; the weight is multiplied by it
    ssim_weight: float | None = None  # of the loss, also for plain models; None: that of `fit`
    # At the cap, Gaussians that ask for growth wait until others are pruned; "freeze": none are.
    at_cap: Literal["wait", "freeze"] = "wait"
    prune_by: Literal["all", "cover"] = "all"  # scenes in which an opaque Gaussian is spared


_PUBLISHED = Design(
    mask=("op", "ro", "sc", "xyz"),
    conditioning="bias",
    hidden=(64, 128),
    branch=64,
    frequencies=0,
    inputs="normalised",
    decoder_rate=5e-5,
    common_poses=1.0,
    incorrect_weight=0.01,
    incorrect_every=1,
    ssim_weight=0.5,
)

DESIGNS: dict[DesignName, Design] = {
    "mlp": Design(),
    "published": _PUBLISHED,
    "released": replace(
        _PUBLISHED, residuals="one-sided", ssim_weight=None, at_cap="freeze", prune_by="cover"
    ),
}


@dataclass(frozen=True, kw_only=True)
class KeyssOptions(JointOptions):
    """The joint training of the published model and its decoders (KeySS, section 3.4).

    `fit` has its length, its size and the rates of Gaussians. The fields that `Design` has too are None for
    the design's own value.
    """

    method: ClassVar[str] = "keyss"

    design: Annotated[
        DesignName,
        CommandLineOption(
            "mlp: the paper's architecture with inputs, rates and poses that work; published: the paper's "
            "text; released: the authors' program."
        ),
    ] = "mlp"
    mask: Annotated[  # theta
        Mask | None,
        CommandLineOption(
            "Attributes that the decoder changes, some of these.",
            metavar="op,ro,sc,xyz,sh",
            default="the design's",
            parse=parse_mask,
        ),
    ] = None
    key_encoder: Annotated[
        Literal["argon2", "clip"],
        CommandLineOption("What conditions the decoder; the encryption always uses Argon2id's key."),
    ] = "argon2"
    clip_model: Annotated[
        str | None,
        CommandLineOption("CLIP for --key-encoder clip.", metavar="FOLDER", default="ViT-L/14 in the cache"),
    ] = None

    weight_decay: float = 1e-4  # of the decoders

    conditioning: Literal["gate", "bias"] | None = None
    hidden: tuple[int, int] | None = None
    branch: int | None = None
    frequencies: int | None = None
    inputs: Literal["standardised", "normalised"] | None = None
    residuals: Literal["signed", "one-sided"] | None = None
    decoder_rate: float | None = None
    common_poses: float | None = None
    incorrect_weight: float | None = None
    incorrect_every: int | None = None
    ssim_weight: float | None = None
    at_cap: Literal["wait", "freeze"] | None = None
    prune_by: Literal["all", "cover"] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        settings = self.settings
        check_above_zero(settings, "decoder_rate")
        if settings.incorrect_every < 1:
            raise UsageError(f"`incorrect_every`: expected at least 1, got {settings.incorrect_every}")
        if self.clip_model is not None and self.key_encoder != "clip":
            raise UsageError(
                '`clip_model` is for the key encoder clip: leave it out or set `key_encoder="clip"`'
            )
        self.check_poses(settings.common_poses)

    @property
    def settings(self) -> Design:
        """The design with what these options override."""
        values = {each.name: getattr(self, each.name) for each in fields(Design)}
        given = {name: value for name, value in values.items() if value is not None}
        return replace(DESIGNS[self.design], **given)

    @classmethod
    def variants(cls) -> Mapping[str, KeyssOptions]:
        """KeySS as published."""
        return {"published": KeyssOptions(design="published")}

    @property
    def decoder_shape(self) -> DecoderShape:
        """Kind and sizes of the decoders; most have the same names."""
        settings = self.settings
        shape = {name: getattr(settings, name) for name in vars(DecoderShape()) if hasattr(settings, name)}
        return DecoderShape(**shape | {"sh_degree": self.fit.sh_degree})

    @property
    def joint_fit(self) -> FitConfig:
        """`fit` with the weight that the design gives SSIM."""
        weight = self.settings.ssim_weight
        return self.fit if weight is None else replace(self.fit, ssim_weight=weight)
