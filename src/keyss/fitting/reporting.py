"""Where the progress of trainings goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from keyss.core.gaussians import Gaussians


class Reporter(Protocol):
    """Where progress goes."""

    @property
    def loss_every(self) -> int:
        """Every so many steps the loss is among the numbers; 0: never, for it costs a GPU its pace."""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        """`iteration` steps of `iterations` are done already, which is more than 0 for a resumed run."""

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        """So many steps are done; `gaussians` is 0 and `numbers` empty where there are none to tell."""

    def note(self, line: str) -> None:
        """Something to know before the work begins."""

    def finish(self) -> None:
        """The work is done, or was interrupted."""


@runtime_checkable
class Modelled(Protocol):
    """A run that trains a model which can be looked at."""

    def gaussians(self) -> Gaussians:
        """The model as it is now; later steps change its tensors."""


@runtime_checkable
class ModelReporter(Protocol):
    """A reporter that looks at the model, too."""

    def look(self, model: Callable[[], Gaussians]) -> None:
        """A step is done; `model` gives what it came to, see `Modelled`."""

    def of_secret(self) -> Reporter:
        """The same reporter, for the training of a secret's model."""


@runtime_checkable
class SeveralReporter(Protocol):
    """A reporter that can be told of several trainings at the same time, some ten times a second of each."""

    def beside(self) -> Reporter:
        """One for another training, while this one is told of its own."""


def of_secret(reporter: Reporter | None) -> Reporter | None:
    """What the training of a secret's model reports to."""
    return reporter.of_secret() if isinstance(reporter, ModelReporter) else reporter


class SilentReporter:
    """Says nothing."""

    loss_every = 0

    def start(self, title: str, iterations: int, iteration: int) -> None: ...

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None: ...

    def note(self, line: str) -> None: ...

    def finish(self) -> None: ...
