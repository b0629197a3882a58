"""Progress of a training: lines, TensorBoard's event files, a local page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keyss.cli.arguments import Training
from keyss.cli.ranks import answers
from keyss.core.extras import import_extra

if TYPE_CHECKING:
    from keyss.fitting.reporting import Reporter
    from keyss.progress import ProgressLines

FOLDER = "private/tensorboard"  # of a run, since its losses may tell about a secret


@contextmanager
def reporting(out: Path, scene: Path, asked: Training) -> Iterator[Reporter]:
    """The reporter of `fit` and `hide`. With --live, a page shows the training while the context is open.

    Raises BackendError if TensorBoard is not installed, OutputError if the page cannot be served.
    """
    from keyss import progress

    reporter: Reporter = tensorboard_reporter(out) if asked.tensorboard else progress.reporter()
    if not (asked.live and answers()):
        yield reporter
        return
    from keyss.files.layout import usual_up
    from keyss.viewer.live import LiveTraining

    with LiveTraining(usual_up(scene)) as page:
        print(f"{page.address} shows the training; only this machine can open it", flush=True)
        yield page.reporter(reporter)


def tensorboard_reporter(out: Path) -> TensorBoardReporter:
    """Progress lines and TensorBoard's event files. Raises BackendError if TensorBoard is not installed."""
    from keyss import progress

    writer = import_extra("torch.utils.tensorboard.writer", "tensorboard", "use --tensorboard").SummaryWriter
    return TensorBoardReporter(progress.reporter(), out / FOLDER, writer)


class TensorBoardReporter:
    """Reports to `lines` and to event files in `folder`, where each training has a subfolder.

    Files are opened when a training starts, since the run's folder exists by then, and closed at its end.
    """

    loss_every = 10  # steps

    def __init__(self, lines: ProgressLines, folder: Path, writer: Any) -> None:
        self.lines, self.folder, self.writer = lines, folder, writer
        self.open: Any = None
        self.last: dict[str, float] = {}

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.lines.start(title, iterations, iteration)
        name = re.sub(r"[^\w-]+", "_", title).strip("_")[:80]
        self.open, self.last = self.writer(str(self.folder / name), purge_step=iteration or None), {}

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

    def beside(self) -> TensorBoardReporter:
        return TensorBoardReporter(self.lines.beside(), self.folder, self.writer)

    def note(self, line: str) -> None:
        self.lines.note(line)

    def finish(self) -> None:
        self.lines.finish()
        if self.open is not None:
            self.open.close()
            self.open = None
