"""Progress of long work on the standard error stream: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn
from rich.table import Column
from rich.text import Text

level = 0  # -1: silent, 1: more often; set by the command line
_DELAY_SECONDS = 1.0  # before a terminal displays a wait
_LOG_SECONDS = 5.0  # after which a silent log gets a line

Share = Callable[[float], None]  # called with the share of the work that is done


class Reporter:
    """Displays the progress of trainings and other long work; this one displays nothing."""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        """A training begins; a resumed one has done `iteration` of its `iterations` steps."""

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        """`iteration` steps are done; `gaussians` is 0 and `numbers` empty if unknown."""

    def note(self, line: str) -> None:
        """Display a line before the training begins."""

    def finish(self) -> None:
        """The training has ended or was interrupted."""

    def waiting(self, what: str, seconds: float) -> AbstractContextManager[Share]:
        """While the context is open, display `what` and the time left of about `seconds`."""
        return nullcontext(lambda share: None)


def reporter(console: Console | None = None) -> ProgressLines:
    """A reporter for `console`, by default the standard error stream: that of long functions."""
    console = console or Console(stderr=True, quiet=level < 0)
    return ProgressLines(console, None if level < 1 or console.is_terminal else 1.0)


class ProgressLines(Reporter):
    """A reporter on a task of rich, which estimates recent speed and remaining time.

    In a terminal, one line is redrawn every 0.25 seconds; elsewhere, for logs, a line is printed whenever
    there was none for 5 seconds. `every` changes this.
    """

    def __init__(
        self,
        console: Console,
        every: float | None = None,
        timer: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console
        self.live = console.is_terminal
        self.every = (0.25 if self.live else _LOG_SECONDS) if every is None else every
        self.timer = timer
        self.displayed = timer()
        self.open = ExitStack()  # the log of a training
        self.task: Task | None = None

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            # A separate column wraps in narrow terminals.
            TextColumn("{task.fields[facts]}", markup=False, table_column=Column()),
            console=self.console,
            auto_refresh=False,
            disable=not self.live,
            get_time=self.timer,
        )
        self.progress.start()
        self.progress.add_task(title, total=iterations, completed=iteration, facts="starting")
        self.task = self.progress.tasks[0]
        self.displayed, self.numbers = self.timer(), ""
        if not self.live:
            where = f", continuing at {iteration}" if iteration else ""
            self.note(f"{title}: {iterations} steps{where}")
            self.open.enter_context(self._logged(self._training))

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        task = self.task
        if task is None:
            return
        self.progress.update(task.id, completed=iteration)
        count = f"{gaussians:,} Gaussians" if gaussians else ""
        self.numbers = _joined(count, *(f"{name} {value:.2f}" for name, value in numbers.items()))
        if self.live and self.timer() - self.displayed >= self.every:  # a thread would take a core
            self.displayed = self.timer()
            self.progress.update(task.id, facts=self._facts(task), refresh=True)

    def _facts(self, task: Task) -> str:
        left = clock(task.time_remaining or 0)
        return _joined(f"{task.speed:.1f} it/s, {left} left" if task.speed else "starting", self.numbers)

    def _training(self) -> str:
        task = self.progress.tasks[0]
        return f"{task.description}: {task.completed}/{task.total}, {self._facts(task)}"

    def finish(self) -> None:
        task, self.task = self.task, None
        if task is None:
            return
        self.open.close()
        duration = f"in {clock(task.elapsed or 0)}"
        self.progress.update(task.id, facts=_joined(duration, self.numbers), refresh=True)
        self.progress.stop()
        if not self.live:
            how = "done" if task.finished else f"stopped at {task.completed}"
            self.note(_joined(f"{task.description}: {how} {duration}", self.numbers))

    def note(self, line: str) -> None:
        self.displayed = self.timer()
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def waiting(self, what: str, seconds: float) -> Iterator[Share]:
        """See `Reporter`. A terminal displays a moving sign after 1 s."""
        wait = Wait(what, seconds, self.timer)

        def display(ended: threading.Event) -> None:
            if not ended.wait(_DELAY_SECONDS):
                with self.console.status(wait, refresh_per_second=4):
                    ended.wait()

        with _beside(display) if self.live else self._logged(lambda: str(wait)):
            yield wait.update

    def _logged(self, line: Callable[[], str]) -> AbstractContextManager[None]:
        """While the context is open, print `line` whenever there was none for `every` seconds."""

        def log(ended: threading.Event) -> None:
            while not ended.wait(max(0, self.displayed + self.every - self.timer())):
                if self.timer() - self.displayed >= self.every:
                    self.note(line())

        return _beside(log)


@contextmanager
def _beside(display: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run `display` in a thread until it gets the event that the context ends."""
    ended = threading.Event()
    thread = threading.Thread(target=display, args=(ended,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Wait:
    """A line on work of a known estimate, at the time when it is displayed."""

    def __init__(self, what: str, seconds: float, timer: Callable[[], float] = time.monotonic) -> None:
        self.what, self.seconds, self.timer = what, max(seconds, 0.1), timer
        self.start, self.share, self.at = timer(), 0.0, timer()

    def update(self, share: float) -> None:
        """`share` of the work, 0 to 1, is done."""
        self.share, self.at = share, self.timer()

    @property
    def left(self) -> float:
        """Seconds left at the pace of the work so far, else as estimated; below 0 if it takes longer."""
        total = (self.at - self.start) / self.share if self.share else self.seconds
        return self.start + total - self.timer()

    def __str__(self) -> str:
        left = self.left
        overdue = left < -1 and self.seconds >= _LOG_SECONDS  # shorter estimates are never displayed
        ending = f"about {about(left)} left" if left >= 1 else "longer than estimated" * overdue
        return f"{self.what}: {_joined(clock(self.timer() - self.start), ending)}"

    def __rich__(self) -> Text:
        return Text(str(self))


def say(*lines: object) -> None:
    """Print lines to the standard output, unless the command is to be quiet."""
    if level >= 0:
        print(*lines, sep="\n")


def waiting(what: str, seconds: float) -> AbstractContextManager[Share]:
    """`Reporter.waiting` on the standard error stream."""
    return reporter().waiting(what, seconds)


def about(seconds: float) -> str:
    """An estimated time, in two digits or so."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def clock(seconds: float) -> str:
    """`m:ss` or `h:mm:ss`."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _joined(*facts: str) -> str:
    return ", ".join(filter(None, facts))
