"""The plan of a run: its stages, its room, and what it will take."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """A part of a run."""

    name: str
    steps: int  # 0 where nothing is trained
    gaussians: int  # at its end, at most
    seconds: float  # a rough estimate


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The plan of a hiding: the method sets the first fields, `keyss.runs.planning` the others.

    Sizes are exact for given models, and upper limits for models that are not fitted yet.
    """

    gaussians: int  # of the published model
    sh_degree: int  # of the published model
    asked: int  # Gaussians of all secrets together
    capacity: int  # Gaussians of the secrets that fit
    steps: int = 0  # of the method's own training
    drawn: tuple[int, ...] = ()  # Gaussians of the cover and of each secret that a step renders
    gaussian_weights: float = 0.0  # of the networks that a step evaluates for each Gaussian
    pixel_weights: float = 0.0  # of the networks that a step evaluates for each rendered pixel
    notes: tuple[str, ...] = ()  # what the options cost, a sentence each

    method: str = ""
    stages: tuple[Stage, ...] = ()
    file_bytes: int = 0  # of the published model, at most
    disk_bytes: int = 0  # of all files that exist at the same time, checkpoints included
    free_bytes: int | None = None  # on their disk; None if nothing is written
    memory_bytes: int = 0  # a rough estimate

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)
