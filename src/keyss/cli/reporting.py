"""Progress of a training: lines, TensorBoard's event files, a local page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from keyss.cli.arguments import Training
from keyss.core.errors import import_extra
from keyss.progress import Reporter, reporter as lines

FOLDER = "private/tensorboard"  # relative to a run; private, since losses may reveal something about a secret


@contextmanager
def reporting(out: Path, scene: Path, training: Training) -> Iterator[Reporter]:
    """The reporter of `fit` and `hide`. With --live, a page shows the training within the context.

    Raises BackendError if TensorBoard is not installed, OutputError if the page cannot be served.
    """
    reporter: Reporter = lines()
    if training.tensorboard:
        reporter = TensorBoardReporter(out, reporter)
    if not training.live:
        yield reporter
        return
    from keyss.viewer.live import LiveTraining
    from keyss.viewer.look import look_of_scene

    with LiveTraining(look_of_scene(scene)) as page:
        print(f"{page.address} shows the training; only this machine can open it", flush=True)
        yield page.reporter(reporter)


class TensorBoardReporter(Reporter):
    """Reports to `lines` and to event files in the run's folder `out`, in a subfolder for each training.

    Files are opened when a training starts, because the run's folder does not exist earlier. Raises
    BackendError if TensorBoard is not installed.
    """

    loss_every = 10  # steps

    def __init__(self, out: Path, lines: Reporter) -> None:
        module = import_extra("torch.utils.tensorboard.writer", "tensorboard", "use --tensorboard")
        self.out, self.lines, self.writer = out, lines, module.SummaryWriter
        self.open: Any = None
        self.last: dict[str, float] = {}

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.lines.start(title, iterations, iteration)
        name = re.sub(r"[^\w-]+", "_", title).strip("_")[:80]
        self.open, self.last = self.writer(str(self.out / FOLDER / name), purge_step=iteration or None), {}

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        measured = {name: value for name, value in numbers.items() if name != "loss"}
        self.lines.update(iteration, gaussians, measured)
        if self.open is None:
            return
        if "loss" in numbers:
            self.open.add_scalar("loss", numbers["loss"], iteration)
            self.open.add_scalar("Gaussians", gaussians, iteration)
        if measured != self.last:
            self.last = measured
            for name, value in measured.items():
                self.open.add_scalar(name, value, iteration)

    def note(self, line: str) -> None:
        self.lines.note(line)

    def finish(self) -> None:
        self.lines.finish()
        if self.open is not None:
            self.open.close()
            self.open = None
