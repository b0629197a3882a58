"""The options of the method `carry`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

from keyss.fitting.config import FitConfig
from keyss.methods.method import CommandLineOption, MethodOptions, Training

REFIT = 1.15  # refit steps / fit steps, with photos; at 1, secrets lose 0.15 dB


@dataclass(frozen=True, kw_only=True)
class CarryOptions(MethodOptions):
    """Options of `carry`; `fit` is for plain models, and a refit adds REFIT times its steps."""

    method: ClassVar[str] = "carry"

    refit: Annotated[
        Literal["auto", "always", "never"],
        CommandLineOption(
            "Train a secret again after pruning it to the cover's capacity: always, if it does not fit, or "
            "never."
        ),
    ] = "auto"
    iterations: int | None = None  # steps per refit; None: REFIT per step of `fit`, fewer without photos

    refits: tuple[int, ...] = ()  # set by `prepare`: refit steps of each secret; 0: no refit

    @property
    def may_train(self) -> bool:
        """True unless the options exclude refits."""
        return self.refit != "never"

    @property
    def may_show(self) -> bool:
        """True if secrets that cannot be hidden unnoticed may be hidden visibly."""
        return self.publish == "as-is" and self.refit == "auto" and self.format is None

    def fits(self, scenes: int) -> list[FitConfig]:
        """A secret without a refit gets the steps of one in addition."""
        alone = round((1 + REFIT) * self.fit.iterations)
        of_secrets = [
            replace(self.fit, iterations=self.fit.iterations if steps else alone)
            for steps in self.refits or (0,) * (scenes - 1)
        ]
        return [self.fit, *of_secrets]

    def training(self, scenes: int) -> tuple[Training, ...]:
        """The refits."""
        return (Training(), *map(Training, self.refits or (0,) * (scenes - 1)))

    def with_fit(self, **changes: Any) -> Self:
        """Options with changed fields of `fit`; `iterations` also changes those of refits."""
        found = super().with_fit(**changes)
        return replace(found, iterations=changes["iterations"]) if "iterations" in changes else found
