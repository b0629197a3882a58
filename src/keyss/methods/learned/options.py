"""What hiding can be told, with the paper's names where it has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

from keyss.core.errors import UsageError
from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.methods.base import CommandLineOption, MethodOptions, SceneInput
from keyss.methods.learned.decoder import DecoderShape, Mask, parse_mask

# Of the joint training where only models are given: iterations at most, factor on the rates.
MODEL_ITERATIONS, MODEL_RATE = 400, 0.1

Scenes = Literal["both", "cover", "secret"]  # "both": all, however many secrets there are


@dataclass(frozen=True, kw_only=True)
class LearnedOptions(MethodOptions):
    """The joint training of the published model and the decoder (KeySS, section 3.4); `fit` has its rates."""

    # Of the joint training: those of `fit` by default, and where only models are given, what suits them.
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
        CommandLineOption("Start from plain models, or all together from sparse points (the paper's)."),
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
            "Attributes that the decoder of --sidecar or --start points changes, some of these.",
            metavar="op,ro,sc,xyz,sh",
            parse=parse_mask,
        ),
    ] = ("op",)
    decoder: Literal["remap", "network"] = "remap"  # the paper has a network
    conditioning: Literal["gate", "bias"] = "gate"  # how the key enters the decoder; bias: the paper's
    hidden: tuple[int, int] = (64, 64)  # widths of a network's common branch
    branch: int = 32  # width of its branch per attribute
    frequencies: int = 6  # octaves of its positional encoding
    design: Literal["standardised", "published"] = "standardised"  # of a network; published: the paper's
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
    sidecar: Annotated[
        bool,
        CommandLineOption(
            "For files that will be quantised: secrets lie in the model as transparent Gaussians, and what "
            "finds them in decoder.sealed."
        ),
    ] = False

    cover_weight: float = 0.5  # beta_cover
    secret_weight: float = 0.5  # beta_secret, of each secret
    incorrect_weight: float = 0.05  # beta_incorrect: wrong keys against the cover; a gate needs none
    incorrect_every: int = 4  # steps between two wrong keys; the weight is multiplied by it

    secret_share: float = 1.0  # warm start: Gaussians of each secret for one of the cover, at most
    warm_rate: float = 1.0  # warm start: factor on the rates of the Gaussians, which are nearly right
    # At the cap, what asks to grow waits until something is pruned; freeze: nothing is (the authors' code).
    at_cap: Literal["wait", "freeze"] = "wait"
    prune_by: Literal["all", "cover"] = "all"  # whose opacities spare a Gaussian; cover: the authors' code

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish != "ply" and not self.in_records:
            raise UsageError(
                f'`publish="{self.publish}"` is for secrets that lie in the published file: leave out '
                '`sidecar=True` and `start="points"`'
            )
        if self.clip_model is not None and self.key_encoder != "clip":
            raise UsageError(
                '`clip_model` is for the key encoder clip: leave it out or set `key_encoder="clip"`'
            )
        if self.poses != "both" and self.common_poses < 1:
            raise UsageError(
                "poses of some scenes only: needs common_poses = 1, for all scenes are drawn from them"
            )
        if self.start == "warm" and "op" not in self.mask:
            raise UsageError(
                f"mask {','.join(self.mask)}: a warm start hides the secret's Gaussians by their opacity and "
                'needs op in the mask; start from points instead (`start="points"`)'
            )
        if self.start == "warm" and self.conditioning == "bias":
            raise UsageError(
                "conditioning bias: a warm start's opacity remap is the same for every key and needs a gate"
            )
        if self.decoder == "remap" and (self.start != "warm" or self.mask != ("op",)):
            raise UsageError(
                "decoder remap: knows nothing but opacities from a warm start; "
                f"mask {','.join(self.mask)} with start {self.start} needs a network"
            )

        if self.in_records and (self.decoder != "remap" or self.key_encoder != "argon2"):
            raise UsageError(
                "secrets in the low bits of the cover have no decoder that a mask or an encoder of keys "
                'could be for; `sidecar=True` or `start="points"` gives them one'
            )

    @property
    def in_records(self) -> bool:
        """Whether secrets are published as Gaussians in the low bits of the cover's, which stay as they are.

        Otherwise cover and secrets are trained together, and a key opens a decoder.
        """
        return self.start == "warm" and not self.sidecar

    def adapted(self, **changes: Any) -> Self:
        """The same with changed fields, and with a network where an opacity remap cannot do it."""
        start, mask = (changes.get(name, getattr(self, name)) for name in ("start", "mask"))
        if start != "warm" or mask != ("op",):
            changes.setdefault("decoder", "network")
        return replace(self, **changes)

    def with_fit(self, **changes: Any) -> Self:
        """The same with changed fields of `fit`; size and length are those of the joint training too."""
        own = {name: changes[name] for name in ("iterations", "max_gaussians") if name in changes}
        return replace(super().with_fit(**changes), **own)


def sized(options: LearnedOptions, inputs: Sequence[SceneInput]) -> LearnedOptions:
    """`options` for the cover and secrets of `inputs`, with the SH degree of the published model.

    Where models are all there is, the published model has the cover's Gaussians, or with a sidecar those of
    all, unless `options.max_gaussians` says otherwise. If nothing of it has to be left out the start is right
    already: the training is short and gentle, for large steps would only do harm.
    """
    degree, cover = options.sh_degree, inputs[0].model
    if degree is None and cover is not None and options.start == "warm":
        degree = cover.sh_degree
    if degree is not None:
        options = replace(options, fit=replace(options.fit, sh_degree=degree))
    models = [each.model for each in inputs if each.model is not None and not each.photos]
    total = sum(len(model) for model in (models[:1] if options.in_records else models))
    if len(models) < len(inputs) or (options.max_gaussians or total) < total:
        return options
    fit = replace(
        options.fit,
        iterations=options.iterations or min(options.fit.iterations, MODEL_ITERATIONS),
        max_gaussians=options.max_gaussians or max(16, total),
    )
    return replace(options, fit=fit, warm_rate=MODEL_RATE * options.warm_rate)


def training_options(options: LearnedOptions) -> LearnedOptions:
    """`options` whose `fit` is that of the joint training."""
    iterations = options.iterations or options.fit.iterations
    cap = options.max_gaussians or options.fit.max_gaussians
    return replace(options, fit=replace(options.fit, iterations=iterations, max_gaussians=cap))


def decoder_shape(options: LearnedOptions) -> DecoderShape:
    """Kind and sizes of the decoder; most have the same names."""
    shape = {name: getattr(options, name) for name in vars(DecoderShape()) if hasattr(options, name)}
    return DecoderShape(**shape | {"kind": options.decoder, "sh_degree": options.fit.sh_degree})


def chosen_scenes(which: Scenes, count: int) -> list[int]:
    """Indices of the scenes that `which` stands for, of the cover (0) and the secrets."""
    return {"both": list(range(count)), "cover": [0], "secret": list(range(1, count))}[which]


_PAPER = LearnedOptions(
    fit=replace(FIT_PRESETS["paper"], ssim_weight=0.5),
    start="points",
    common_poses=1.0,
    mask=("op", "ro", "sc", "xyz"),
    decoder="network",
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
