"""The options of the method `carry`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

from keyss.fitting.config import FitConfig
from keyss.methods.method import CommandLineOption, MethodOptions, Training

FINE_TUNING = 1.15  # fine-tuning steps / fit steps, with photos; at 1, secrets lose 0.15 dB


@dataclass(frozen=True, kw_only=True)
class CarryOptions(MethodOptions):
    """Options of `carry`; `fit` is for plain models, and fine-tuning adds FINE_TUNING times its steps."""

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

    fine_tuning_steps: tuple[int, ...] = ()  # set by `prepare`: of each secret; 0: no fine-tuning

    @property
    def may_train(self) -> bool:
        """True unless the options exclude fine-tuning."""
        return self.fine_tune != "never"

    @property
    def may_show(self) -> bool:
        """True if secrets that cannot be hidden unnoticed may be hidden visibly."""
        return self.publish == "unchanged" and self.fine_tune == "auto" and self.format is None

    def fits(self, scenes: int) -> list[FitConfig]:
        """A secret without fine-tuning gets its steps in addition."""
        alone = round((1 + FINE_TUNING) * self.fit.iterations)
        of_secrets = [
            replace(self.fit, iterations=self.fit.iterations if steps else alone)
            for steps in self.fine_tuning_steps or (0,) * (scenes - 1)
        ]
        return [self.fit, *of_secrets]

    def training(self, scenes: int) -> tuple[Training, ...]:
        """Fine-tuning."""
        return (Training(), *map(Training, self.fine_tuning_steps or (0,) * (scenes - 1)))

    def with_fit(self, **changes: Any) -> Self:
        """Options with changed fields of `fit`; `iterations` also changes those of fine-tuning."""
        found = super().with_fit(**changes)
        return replace(found, iterations=changes["iterations"]) if "iterations" in changes else found
