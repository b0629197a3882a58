"""Protocols of what displays the progress of trainings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from keyss.core.gaussians import Gaussians


class Reporter(Protocol):
    """Displays progress."""

    @property
    def loss_every(self) -> int:
        """Steps between two losses among the numbers; 0: none, since reading it slows a GPU down."""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        """A training begins; a resumed one has done `iteration` of its `iterations` steps."""

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        """`iteration` steps are done; `gaussians` is 0 and `numbers` empty if unknown."""

    def note(self, line: str) -> None:
        """Display a line before the training begins."""

    def finish(self) -> None:
        """The training has ended or was interrupted."""


@runtime_checkable
class Modelled(Protocol):
    """A run whose model can be displayed."""

    def gaussians(self) -> Gaussians:
        """The present model; later steps change its tensors."""


@runtime_checkable
class ModelReporter(Protocol):
    """A reporter that displays the model, too."""

    def look(self, model: Callable[[], Gaussians]) -> None:
        """A step is done; `model` returns the present model, see `Modelled`."""

    def of_secret(self) -> Reporter:
        """A reporter for the training of a secret."""


@runtime_checkable
class SeveralReporter(Protocol):
    """A reporter that can display several trainings at the same time, with ten updates a second of each."""

    def beside(self) -> Reporter:
        """A reporter for one more training."""


def of_secret(reporter: Reporter | None) -> Reporter | None:
    """The reporter for the training of a secret."""
    return reporter.of_secret() if isinstance(reporter, ModelReporter) else reporter


class SilentReporter:
    """Displays nothing."""

    loss_every = 0

    def start(self, title: str, iterations: int, iteration: int) -> None: ...

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None: ...

    def note(self, line: str) -> None: ...

    def finish(self) -> None: ...
