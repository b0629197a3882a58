"""The options of KeySS, with the paper's names where it has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Literal

from keyss.core.errors import UsageError
from keyss.methods.base import CommandLineOption
from keyss.methods.joint import JointOptions
from keyss.methods.keyss.decoder import Mask, parse_mask
from keyss.methods.keyss.designs.base import Design
from keyss.methods.keyss.designs.carriers import CARRIERS
from keyss.methods.keyss.designs.network import MLP, PUBLISHED, RELEASED

DesignName = Literal["carriers", "mlp", "published", "released"]

_DESIGNS: dict[DesignName, Design] = {
    "carriers": CARRIERS,
    "mlp": MLP,
    "published": PUBLISHED,
    "released": RELEASED,
}
_OTHERS = ("clip_model",)  # options that are None by default and no setting of a design


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
            "carriers: rows that are a Gaussian of each scene; mlp: the paper's architecture with inputs, "
            "rates and poses that work; published: the paper's text; released: the authors' program."
        ),
    ] = "carriers"
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

    weight_decay: float | None = None
    conditioning: Literal["gate", "bias"] | None = None
    hidden: tuple[int, int] | None = None
    branch: int | None = None
    frequencies: int | None = None
    inputs: Literal["standardised", "normalised"] | None = None
    residuals: Literal["signed", "one-sided"] | None = None
    decoder_rate: float | None = None
    common_poses: float | None = None
    incorrect_weight: float | None = None
    ssim_weight: float | None = None
    at_cap: Literal["even", "wait", "freeze"] | None = None
    prune_by: Literal["all", "cover"] | None = None
    pruned_steps: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        settings = self.settings
        if self.clip_model is not None and self.key_encoder != "clip":
            raise UsageError(
                '`clip_model` is for the key encoder clip: leave it out or set `key_encoder="clip"`'
            )
        self.check_poses(settings.common_poses)
        if self.key_encoder == "clip" and not hasattr(settings, "mask"):
            raise UsageError(
                f'`key_encoder="clip"`: the embedding encrypts in the design {self.design}, and CLIP is no '
                "key derivation; use a design with a network"
            )
        if (self.points, self.densification) != ("both", "both") and not hasattr(settings, "mask"):
            raise UsageError(
                f"`points` and `densification`: in the design {self.design} each scene has its own"
            )

    @property
    def settings(self) -> Any:
        """The `Design` with the settings that these options override. Raises UsageError for unknown ones."""
        chosen = _DESIGNS[self.design]
        own = [each.name for each in fields(self) if each.default is None and each.name not in _OTHERS]
        given = {name: getattr(self, name) for name in own if getattr(self, name) is not None}
        if foreign := [name for name in given if not hasattr(chosen, name)]:
            raise UsageError(
                f"`{foreign[0]}`: the design {self.design} has no such setting: leave it out or set another "
                "`design`"
            )
        return replace(chosen, **given)

    @classmethod
    def variants(cls) -> Mapping[str, KeyssOptions]:
        """KeySS as published."""
        return {"published": KeyssOptions(design="published")}
