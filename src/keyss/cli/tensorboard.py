"""Losses and measures of a training in TensorBoard's event files, while it runs (extra `tensorboard`)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keyss.core.errors import BackendError

if TYPE_CHECKING:
    from keyss.fitting.loop import Reporter
    from keyss.progress import ProgressLines

FOLDER = "private/tensorboard"  # of a run: what is trained on may be secret


def reporter(out: Path, *, tensorboard: bool) -> Reporter:
    """What `fit` and `hide` report to: the standard error stream and, where asked for, TensorBoard as well.

    Raises BackendError where it is asked for and not installed.
    """
    from keyss import progress

    shown = progress.reporter()
    if not tensorboard:
        return shown
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as error:
        raise BackendError(
            f"--tensorboard needs the package tensorboard (pip install 'keyss[tensorboard]'): {error}"
        ) from error
    return TensorBoardReporter(shown, out / FOLDER, SummaryWriter)


class TensorBoardReporter:
    """Passes all on to `shown`, and writes it below `folder`: a run of TensorBoard's for each training.

    Files are opened when a training starts, when the run's folder is there, and closed at its end.
    """

    loss_every = 10  # steps

    def __init__(self, shown: ProgressLines, folder: Path, writer: Any) -> None:
        self.shown, self.folder, self.writer = shown, folder, writer
        self.open: Any = None
        self.last: dict[str, float] = {}

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.shown.start(title, iterations, iteration)
        name = re.sub(r"[^\w-]+", "_", title).strip("_")[:80]
        self.open, self.last = self.writer(str(self.folder / name), purge_step=iteration or None), {}

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        seen = {name: value for name, value in numbers.items() if name != "loss"}
        self.shown.update(iteration, gaussians, seen)
        if self.open is None:
            return
        if "loss" in numbers:
            self.open.add_scalar("loss", numbers["loss"], iteration)
            self.open.add_scalar("Gaussians", gaussians, iteration)
        if seen != self.last:
            self.last = seen
            for name, value in seen.items():
                self.open.add_scalar(name, value, iteration)

    def beside(self) -> TensorBoardReporter:
        return TensorBoardReporter(self.shown.beside(), self.folder, self.writer)

    def note(self, line: str) -> None:
        self.shown.note(line)

    def finish(self) -> None:
        self.shown.finish()
        if self.open is not None:
            self.open.close()
            self.open = None
