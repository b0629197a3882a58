"""Arguments that several commands take, and how one that may be left out is described."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import UseAppendAction, arg

if TYPE_CHECKING:
    from collections.abc import Mapping

    from keyss.fitting.config import FitConfig


def optional(metavar: str, help: str, otherwise: str, aliases: list[str] | None = None) -> Any:
    """An argument that may be left out; `otherwise` says what happens then."""
    hint = f"(default: {otherwise})"
    return arg(metavar=metavar, help=help, help_behavior_hint=hint, aliases=aliases)


Device = Annotated[
    Literal["auto", "cpu", "cuda"], arg(help="Where to compute; auto takes a CUDA GPU where there is one.")
]
Seed = Annotated[
    int | None, optional("N", "Seed of everything random, to repeat a run.", "drawn by the system")
]
KeyFiles = Annotated[
    UseAppendAction[tuple[Path, ...]],
    optional("FILE", "File with the key, once for each secret.", "KEYSS_KEY, or a hidden prompt"),
]
Width = Annotated[
    int | None, optional("PIXELS", "Photos wider than this are downscaled to it.", "as they are")
]
Background = Annotated[
    tuple[float, float, float] | None,
    optional(
        "R G B",
        "Colour behind everything, 0 to 1 each; transparent photos get it.",
        "white if there are any, else black",
    ),
]
SkipMissing = Annotated[bool, arg(help="Leave out photos that a scene names but that are not there.")]
Iterations = Annotated[int | None, optional("N", "Steps of training.", "the preset's")]
ViewsPerStep = Annotated[
    int | None, optional("N", "Photos of a step, in all processes together.", "one in each")
]
MaxGaussians = Annotated[int | None, optional("N", "Cap on the size of a model.", "the preset's")]
Overwrite = Annotated[bool, arg(help="Replace results that are already there.")]
Resume = Annotated[bool, arg(help="Continue an interrupted run in the same folder.")]
TensorBoard = Annotated[bool, arg(help="Write losses to private/tensorboard in the results as it trains.")]
Live = Annotated[bool, arg(help="Show the model as it trains, on a page of this machine.")]
MasterKeyFile = Annotated[
    Path | None,
    optional("FILE", "File with a key from which each gets its own (`keyss key-of`).", "none"),
]
Jobs = Annotated[
    int | None,
    optional("N", "How many at once; the cores are divided among them.", "as cores and memory allow"),
]
Ray = Annotated[
    str | None,
    optional("ADDRESS", "Run on the Ray cluster at this address, or on a `local` one.", "processes here"),
]
OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="FOLDER", help="Folder for the results.")]


def preset_sizes(presets: Mapping[str, FitConfig]) -> str:
    """What each preset comes to, as a sentence."""
    sizes = [f"{name} {fit.iterations:,} and {fit.max_gaussians:,}" for name, fit in presets.items()]
    return f"Steps of each training, and Gaussians of each model at most: {'; '.join(sizes)}."


def schedule(
    iterations: int | None, max_gaussians: int | None, seed: int | None, views_per_step: int | None
) -> dict[str, int]:
    """What was asked for on the command line of the fields of `FitConfig`."""
    asked = {"iterations": iterations, "max_gaussians": max_gaussians}
    asked |= {"seed": seed, "views_per_step": views_per_step}
    return {name: value for name, value in asked.items() if value is not None}


def checked_seed(seed: int, most: int = 2**32 - 1) -> int:
    """The seed, if every generator takes it. Raises UsageError."""
    from keyss.core.errors import UsageError

    if not 0 <= seed <= most:
        raise UsageError(f"--seed: expected 0 to {most}, got {seed}")
    return seed
