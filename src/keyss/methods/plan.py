"""What a hiding will take, known before it begins."""

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
    """A hiding before it begins: its method knows the first fields, `keyss.runs.planning` adds the others.

    Sizes are exact for given models, and upper limits for those that are still to be fitted.
    """

    gaussians: int  # of the published model
    sh_degree: int  # of the published model
    asked: int  # Gaussians of all secrets together
    capacity: int  # of these, how many fit
    steps: int = 0  # of the method's own training
    drawn: tuple[int, ...] = ()  # Gaussians of the cover and of each secret that a step renders
    gaussian_weights: float = 0.0  # of the networks that each Gaussian of the model goes through in a step
    pixel_weights: float = 0.0  # of the networks that each rendered pixel goes through in a step
    notes: tuple[str, ...] = ()  # what the options cost, a sentence each

    method: str = ""
    stages: tuple[Stage, ...] = ()
    file_bytes: int = 0  # of the published model, at most
    disk_bytes: int = 0  # of all files that exist at the same time, checkpoints included
    free_bytes: int | None = None  # where they are to be written, None without such a place
    memory_bytes: int = 0  # a rough estimate

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)
