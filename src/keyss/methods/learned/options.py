"""What hiding can be told, with the paper's names where it has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

from keyss.core.errors import UsageError
from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.methods.base import (
    CommandLineOption,
    MethodOptions,
    SceneInput,
    Training,
    check_above_zero,
)
from keyss.methods.learned.decoder import DecoderShape, Mask, parse_mask

# Of the training of secrets where only models are given: iterations at most, factor on the rates.
MODEL_ITERATIONS, MODEL_RATE = 400, 0.1

Scenes = Literal["both", "cover", "secret"]  # "both": all, however many secrets there are


@dataclass(frozen=True, kw_only=True)
class LearnedOptions(MethodOptions):
    """The training of secrets for their cover, or from points of the published model and its decoders (KeySS,
    section 3.4); `fit` has its rates.
    """

    # Of that training: those of `fit` by default, and where only models are given, what suits them.
    iterations: int | None = None
    max_gaussians: int | None = None

    sh_degree: Annotated[
        int | None,
        CommandLineOption(
            "Degree of the published model's spherical harmonics, 0 to 3; without it the cover's.",
            metavar="N",
        ),
    ] = None

    start: Annotated[
        Literal["warm", "points"],
        CommandLineOption(
            "Train secrets from plain models, or all together from sparse points (the paper's)."
        ),
    ] = "warm"
    points: Scenes = "both"  # start from points: whose sparse points (combined SfM initialisation)
    poses: Scenes = "both"  # whose training poses are drawn (combined camera poses)
    densification: Scenes = "both"  # whose screen-space gradients ask for growth (combined densification)
    # Steps at which all scenes are drawn from one pose, photo or plain model's render; at the others each is
    # drawn from a pose of its own and compared with its photo. The paper has the first kind only.
    common_poses: float = 0.1

    mask: Annotated[  # theta
        Mask,
        CommandLineOption(
            "Attributes that the decoder of --start points changes, some of these.",
            metavar="op,ro,sc,xyz,sh",
            parse=parse_mask,
        ),
    ] = ("op",)
    conditioning: Literal["gate", "bias"] = "gate"  # how the key enters the decoder; bias: the paper's
    hidden: tuple[int, int] = (64, 64)  # widths of its common branch
    branch: int = 32  # width of its branch per attribute
    frequencies: int = 6  # octaves of its positional encoding
    design: Literal["standardised", "published"] = "standardised"  # published: the paper's
    residuals: Literal["signed", "one-sided"] = "signed"  # one-sided: ReLU on all but the opacity's
    decoder_rate: float = 1e-3  # of AdamW, decays to 5 % of it
    weight_decay: float = 1e-4
    key_encoder: Annotated[
        Literal["argon2", "clip"],
        CommandLineOption("What conditions that decoder; the encryption is always under Argon2id's key."),
    ] = "argon2"
    clip_model: Annotated[
        str | None,
        CommandLineOption("CLIP for --key-encoder clip; without it ViT-L/14 in the cache.", metavar="FOLDER"),
    ] = None

    cover_weight: float = 0.5  # beta_cover
    secret_weight: float = 0.5  # beta_secret, of each secret
    incorrect_weight: float = 0.05  # beta_incorrect: wrong keys against the cover; a gate needs none
    incorrect_every: int = 4  # steps between two wrong keys; the weight is multiplied by it

    secret_share: float = 1.0  # warm start: Gaussians of each secret for one of the cover, at most
    warm_rate: float = 1.0  # warm start: factor on the rates of its Gaussians, which are nearly right
    # At the cap, what asks to grow waits until something is pruned; freeze: nothing is (the authors' code).
    at_cap: Literal["wait", "freeze"] = "wait"
    prune_by: Literal["all", "cover"] = "all"  # whose opacities spare a Gaussian; cover: the authors' code

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish != "ply" and self.start == "points":
            raise UsageError(
                f'`publish="{self.publish}"` is for secrets without a decoder, which takes every bit of the '
                'published model: leave out `start="points"`'
            )
        check_above_zero(self, "cover_weight", "secret_weight", "decoder_rate", "warm_rate", "secret_share")
        if self.incorrect_every < 1:
            raise UsageError(f"`incorrect_every`: expected at least 1, got {self.incorrect_every}")
        if self.clip_model is not None and self.key_encoder != "clip":
            raise UsageError(
                '`clip_model` is for the key encoder clip: leave it out or set `key_encoder="clip"`'
            )
        if self.poses != "both" and self.common_poses < 1:
            raise UsageError(
                "poses of some scenes only: needs common_poses = 1, for all scenes are drawn from them"
            )
        decoding = self.mask != ("op",) or self.conditioning != "gate" or self.key_encoder != "argon2"
        if self.start == "warm" and decoding:
            raise UsageError(
                "secrets that start from plain models have no decoder that a mask or an encoder of keys "
                'could be for; `start="points"` gives them one'
            )

    def training(self, scenes: int) -> tuple[Training, ...]:
        """Of secrets that go on from plain models, or of all scenes together."""
        steps = self.iterations or self.fit.iterations
        if self.start == "points":
            return (Training(steps, goes_on=False),) * scenes
        return (Training(), *[Training(steps)] * (scenes - 1))

    def with_fit(self, **changes: Any) -> Self:
        """The same with changed fields of `fit`; size and length are those of the training too."""
        own = {name: changes[name] for name in ("iterations", "max_gaussians") if name in changes}
        return replace(super().with_fit(**changes), **own)


def sized(options: LearnedOptions, inputs: Sequence[SceneInput]) -> LearnedOptions:
    """`options` for the cover and secrets of `inputs`, with the SH degree of the published model.

    Where models are all there is, and the cover is not to have fewer Gaussians, the start is right already:
    the training is short and gentle, for large steps would only do harm.
    """
    degree, cover = options.sh_degree, inputs[0].model
    if degree is None and cover is not None and options.start == "warm":
        degree = cover.sh_degree
    if degree is not None:
        options = replace(options, fit=replace(options.fit, sh_degree=degree))
    photos = any(each.model is None or each.photos for each in inputs)
    if options.start == "points" or cover is None or photos:
        return options
    if (options.max_gaussians or len(cover)) < len(cover):
        return options
    fit = replace(
        options.fit,
        iterations=options.iterations or min(options.fit.iterations, MODEL_ITERATIONS),
        max_gaussians=options.max_gaussians or max(16, len(cover)),
    )
    return replace(options, fit=fit, warm_rate=MODEL_RATE * options.warm_rate)


def training_options(options: LearnedOptions) -> LearnedOptions:
    """`options` whose `fit` is that of the method's own training."""
    iterations = options.iterations or options.fit.iterations
    cap = options.max_gaussians or options.fit.max_gaussians
    return replace(options, fit=replace(options.fit, iterations=iterations, max_gaussians=cap))


def decoder_shape(options: LearnedOptions) -> DecoderShape:
    """Kind and sizes of the decoder; most have the same names."""
    shape = {name: getattr(options, name) for name in vars(DecoderShape()) if hasattr(options, name)}
    return DecoderShape(**shape | {"sh_degree": options.fit.sh_degree})


def decodings(options: LearnedOptions, secrets: int) -> float:
    """How often all Gaussians go through a decoder in a step of the joint training, in the mean."""
    return secrets + (1 / options.incorrect_every if options.conditioning == "bias" else 0.0)


def chosen_scenes(which: Scenes, count: int) -> list[int]:
    """Indices of the scenes that `which` stands for, of the cover (0) and the secrets."""
    return {"both": list(range(count)), "cover": [0], "secret": list(range(1, count))}[which]


_PAPER = LearnedOptions(
    fit=replace(FIT_PRESETS["paper"], ssim_weight=0.5),
    start="points",
    common_poses=1.0,
    mask=("op", "ro", "sc", "xyz"),
    conditioning="bias",
    hidden=(64, 128),
    branch=64,
    frequencies=0,
    design="published",
    decoder_rate=5e-5,
    incorrect_weight=0.01,
    incorrect_every=1,
)

PRESETS: dict[str, LearnedOptions] = {
    "best": LearnedOptions(),
    "quick": LearnedOptions(fit=FIT_PRESETS["quick"]),
    # The paper as written, and what its authors' code does otherwise: for comparison only.
    "paper": _PAPER,
    "released": replace(
        _PAPER, fit=FIT_PRESETS["paper"], residuals="one-sided", at_cap="freeze", prune_by="cover"
    ),
}
