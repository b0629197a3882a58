"""What carrying can be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.methods.base import CommandLineOption, MethodOptions


@dataclass(frozen=True, kw_only=True)
class CarryOptions(MethodOptions):
    """Nothing is trained but the plain models of scenes, by `fit`."""

    prune_to_fit: Annotated[
        bool, CommandLineOption("Leave out the least visible Gaussians of too large a secret.", alias="thin")
    ] = False
    dither: Annotated[bool, CommandLineOption("Give the cover new low bits where they are not random.")] = (
        False
    )


PRESETS: dict[str, CarryOptions] = {
    "best": CarryOptions(),
    "quick": CarryOptions(fit=FIT_PRESETS["quick"]),
    "paper": CarryOptions(fit=FIT_PRESETS["paper"]),
}
