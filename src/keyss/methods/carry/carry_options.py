"""The options of the method `carry`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

from keyss.fitting.config import FitConfig
from keyss.methods.method import CommandLineOption, MethodOptions

FINE_TUNING = 1.15  # fine-tuning steps / fit steps, with photos; at 1, secrets lose 0.15 dB


@dataclass(frozen=True, kw_only=True)
class CarryOptions(MethodOptions):
    """Options of `carry`; secrets of photos get 1 + FINE_TUNING = 2.15 times the steps of `fit`.

    The last 1.15 are of fine-tuning, where it is needed. `with_fit(iterations=N)` and `--iterations N` give N
    steps to each plain model and to each fine-tuning.
    """

    method: ClassVar[str] = "carry"

    fine_tune: Annotated[
        Literal["auto", "always", "never"],
        CommandLineOption(
            "Train a secret again after pruning it to the cover's capacity: always, if it does not fit, or "
            "never."
        ),
    ] = "auto"
    iterations: int | None = (
        None  # steps of fine-tuning; None: FINE_TUNING per step of `fit`, fewer without photos
    )

    def fits(self, scenes: int) -> list[FitConfig]:
        """See `MethodOptions`. Secrets by default train for the steps of fine-tuning in addition."""
        if self.iterations is not None:
            return [self.fit] * scenes
        secret = replace(self.fit, iterations=round((1 + FINE_TUNING) * self.fit.iterations))
        return [self.fit] + [secret] * (scenes - 1)

    def with_fit(self, **changes: Any) -> Self:
        """Options with changed fields of `fit`; `iterations` also changes those of fine-tuning."""
        options = super().with_fit(**changes)
        return replace(options, iterations=changes["iterations"]) if "iterations" in changes else options
