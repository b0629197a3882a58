"""Options of the method `carry`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

from keyss.core.errors import UsageError
from keyss.fitting.config import FitConfig
from keyss.methods.base import CommandLineOption, MethodOptions, Training
from keyss.methods.records.encoding import record_degree


@dataclass(frozen=True, kw_only=True)
class CarryOptions(MethodOptions):
    """Plain models are fitted by `fit`, those of secrets for twice as many steps, refits included."""

    method: ClassVar[str] = "carry"

    refit: Annotated[
        Literal["auto", "always", "never"],
        CommandLineOption("Refit secrets to the room in the cover; auto: those that do not fit into it."),
    ] = "auto"
    prune_to_fit: Annotated[
        bool,
        CommandLineOption("Leave out the least visible Gaussians of too large a secret, without a refit."),
    ] = False
    dither: Annotated[bool, CommandLineOption("Give the cover new low bits where they are not random.")] = (
        False
    )
    sh_degree: Annotated[
        int | None,
        CommandLineOption(
            "Degree of the published model's spherical harmonics, 0 to 3.", metavar="N", default="the cover's"
        ),
    ] = None
    iterations: int | None = None  # of a refit; None: those of `fit`, and fewer where there are no photos

    # Set by `prepare`: steps of the refit of each secret, 0 for those that are carried as they are.
    refits: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.refit == "always" and self.prune_to_fit:
            raise UsageError('`prune_to_fit` is instead of a refit: leave it out, or `refit="always"`')

    @property
    def may_train(self) -> bool:
        """Unless refits are ruled out."""
        return self.refit != "never" and not self.prune_to_fit

    def fits(self, scenes: int) -> list[FitConfig]:
        """Of a secret twice the steps where no refit follows, and no more harmonics than can be carried."""
        degree = self.fit.sh_degree
        if self.place.records:
            degree = record_degree(degree) or 0
        of_secrets = [
            replace(self.fit, sh_degree=degree, iterations=self.fit.iterations * (1 if steps else 2))
            for steps in self.refits or (0,) * (scenes - 1)
        ]
        return [self.fit, *of_secrets]

    def training(self, scenes: int) -> tuple[Training, ...]:
        """The refits."""
        return (Training(), *map(Training, self.refits or (0,) * (scenes - 1)))

    def with_fit(self, **changes: Any) -> Self:
        """The same with changed fields of `fit`; `iterations` are those of refits too."""
        found = super().with_fit(**changes)
        return replace(found, iterations=changes["iterations"]) if "iterations" in changes else found
