"""Options that several commands take."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from keyss.core.errors import InputError, UsageError
from keyss.files.inputs import STANDARD

if TYPE_CHECKING:
    from keyss.core import ViewOptions


def optional(metavar: str, help: str, default: str = "", aliases: list[str] | None = None) -> Any:
    """An option whose default is None or empty; the help shows `default` instead."""
    hint = f"(default: {default})" if default else ""
    return arg(metavar=metavar, help=help, help_behavior_hint=hint, aliases=aliases)


def switch(help: str, name: str | None = None) -> Any:
    """An option without a value."""
    return arg(name=name, help=help, help_behavior_hint="")


Device = Annotated[Literal["auto", "cpu", "cuda"], arg(help="Device; auto uses a CUDA GPU if there is one.")]
Seed = Annotated[int | None, optional("N", "Seed of all random numbers, to repeat a run.", "random")]
KeyFiles = Annotated[
    UseAppendAction[tuple[Path, ...]],
    optional("FILE", "Key file, one for each secret; - for stdin.", "KEYSS_KEY or a prompt"),
]
OneKeyFile = Annotated[
    UseAppendAction[tuple[Path, ...]],
    optional("FILE", "Key file; - for stdin.", "KEYSS_KEY or a prompt"),
]
KeyFilesToCheck = Annotated[
    UseAppendAction[tuple[Path, ...]],
    optional("FILE", "Key file of a secret to check; repeat for more.", "KEYSS_KEY, else no key"),
]
# The parser breaks lines at any comma.
PRESETS = (
    "Training steps and maximum number of Gaussians of each model: quick 500 and 10k; default 1k and 30k, on "
    "CUDA as full; full 30k and 500k, on CUDA 1M."
)
PresetName = Literal["quick", "default", "full"]
Preset = Annotated[PresetName, arg(help=PRESETS)]
MIN_WIDTH = 16  # pixels; smaller pictures show nothing
Width = Annotated[
    int | None,
    optional(
        "PIXELS",
        "Downscale wider photos to this width; the width of renders of a model without photos.",
        "the photos' own, 400 for renders",
    ),
]
Iterations = Annotated[
    int | None, optional("N", "Training steps of each model, and of fine-tuning.", "the preset's")
]
MaxGaussians = Annotated[int | None, optional("N", "Maximum number of Gaussians of a model.", "the preset's")]
Overwrite = Annotated[bool, switch("Replace existing results.")]
Resume = Annotated[bool, switch("Continue an interrupted run in the same folder.")]
Run = Annotated[Positional[Path], arg(metavar="RUN", help="Result folder of `keyss hide`.")]
OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="FOLDER", help="Folder for the results.")]


@dataclass(frozen=True, kw_only=True)
class Photos:
    """How photos are read."""

    width: Width = None
    background: Annotated[
        tuple[float, float, float] | None,
        optional(
            "R G B",
            "Background colour, 0 to 1 each; transparent photos are composited over it.",
            "white for transparent photos, else that of their edges if it is plain, else black",
        ),
    ] = None
    skip_missing: Annotated[
        bool, switch("Skip photos that are missing or damaged or have no usable camera.")
    ] = False

    def views(self) -> ViewOptions:
        """As an argument of the public functions."""
        from keyss.core import ViewOptions

        if self.width is not None and self.width < MIN_WIDTH:
            raise UsageError(f"--width: expected at least {MIN_WIDTH} pixels, got {self.width}")
        return ViewOptions(**vars(self))


@dataclass(frozen=True, kw_only=True)
class Training:
    """How models are trained."""

    iterations: Iterations = None
    max_gaussians: MaxGaussians = None
    seed: Seed = None

    def schedule(self) -> dict[str, int]:
        """The fields of `FitConfig` that are given."""
        return {name: value for name, value in vars(self).items() if value is not None}


PHOTOS, TRAINING = Photos(), Training()


def flag(name: str) -> str:
    """`--max-gaussians` for `max_gaussians`."""
    return f"--{name.replace('_', '-')}"


def check_exists(*paths: Path | None, keys: Sequence[Path] = ()) -> None:
    """Raise InputError if an input does not exist, UsageError if - is given twice. Does not import torch."""
    names = [str(path) for path in (*paths, *keys) if path is not None]
    if names.count(STANDARD) > 1:
        raise UsageError("- is given twice, and standard input holds one model or key: use files for others")
    for name in names:
        if name != STANDARD and not os.path.lexists(name):
            cure = "; `keyss keygen -o FILE` makes a key for a new secret" if Path(name) in keys else ""
            raise InputError(f"{name} does not exist{cure}")


def check_seed(seed: int) -> int:
    """Return `seed`. Raises UsageError unless every generator accepts it."""
    if not 0 <= seed < 1 << 32:
        raise UsageError(f"--seed: expected 0 to {(1 << 32) - 1}, got {seed}")
    return seed


def waiting_for(task: str, what: str, model: Path) -> AbstractContextManager[Any]:
    """While the context is open, a line says `what` is done and how long the task takes for a model."""
    from keyss.progress import waiting
    from keyss.runs.estimates import seconds_for

    return waiting(f"{what} {model.name}", seconds_for(task, model))


def verb(name: str) -> Any:
    """The function `name` of `keyss`; a line says that it is loaded, as importing torch takes seconds."""
    import keyss
    from keyss.progress import waiting

    with waiting("starting", 2.0):
        return getattr(keyss, name)
