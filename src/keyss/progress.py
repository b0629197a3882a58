"""Progress of long work on the standard error stream: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn
from rich.table import Column

level = 0  # -1 says nothing, 1 more often; set by the command line


def reporter(console: Console | None = None) -> ProgressLines:
    """For the standard error stream, or `console`."""
    console = console or Console(stderr=True, quiet=level < 0)
    return ProgressLines(console, None if level < 1 or console.is_terminal else 1.0)


class _Bars:
    """The lines of all trainings of the moment, below each other: a terminal has room for one such block."""

    def __init__(self) -> None:
        self.progress: Progress | None = None
        self.open = 0

    def add(self, made: Callable[[], Progress]) -> Progress:
        """The block with one line more; a new one where there is none."""
        if self.progress is None:
            self.progress = made()
            self.progress.start()
        self.open += 1
        return self.progress

    def close(self) -> None:
        """A line is done; what all are is drawn a last time."""
        self.open -= 1
        if self.open == 0 and self.progress is not None:
            self.progress.stop()
            self.progress = None


class ProgressLines:
    """A `Reporter` on a task of rich, which knows the speed of the recent past and the time that is left.

    In a terminal it is one line that is redrawn, elsewhere a line now and then, for logs; `every` so many
    seconds, by default 0.25 and 10. It draws from `update`: no thread that training would share its cores
    with.
    """

    loss_every = 0

    def __init__(
        self,
        console: Console,
        every: float | None = None,
        timer: Callable[[], float] = time.monotonic,
        bars: _Bars | None = None,
    ) -> None:
        self.console = console
        self.live = console.is_terminal
        self.every = (0.25 if self.live else 10.0) if every is None else every
        self.timer = timer
        self.bars = bars or _Bars()
        self.task: Task | None = None

    def beside(self) -> ProgressLines:
        """Of another training at the same time: in a terminal the line below."""
        return ProgressLines(self.console, self.every, self.timer, self.bars)

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.progress = self.bars.add(self._block)
        number = self.progress.add_task(title, total=iterations, completed=iteration, facts="starting")
        self.task = next(task for task in self.progress.tasks if task.id == number)
        self.shown, self.numbers = self.timer(), ""
        if not self.live:
            where = f", continuing at {iteration}" if iteration else ""
            self._say(f"{title}: {iterations} steps{where}")

    def _block(self) -> Progress:
        return Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            # The column of its own wraps where the terminal is narrow.
            TextColumn("{task.fields[facts]}", markup=False, table_column=Column()),
            console=self.console,
            auto_refresh=False,
            disable=not self.live,
            get_time=self.timer,
        )

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        task = self.task
        if task is None:
            return
        self.progress.update(task.id, completed=iteration)
        count = f"{gaussians:,} Gaussians" if gaussians else ""
        self.numbers = _joined(count, *(f"{name} {value:.2f}" for name, value in numbers.items()))
        if self.timer() - self.shown < self.every:
            return
        self.shown = self.timer()
        left = clock(task.time_remaining or 0)
        facts = _joined(f"{task.speed:.1f} it/s, {left} left" if task.speed else "starting", self.numbers)
        self.progress.update(task.id, facts=facts, refresh=True)
        if not self.live:
            self._say(f"{task.description}: {iteration}/{task.total}, {facts}")

    def note(self, line: str) -> None:
        self._say(line)

    def finish(self) -> None:
        task, self.task = self.task, None
        if task is None:
            return
        spent = f"in {clock(task.elapsed or 0)}"
        self.progress.update(task.id, facts=_joined(spent, self.numbers), refresh=True)
        self.bars.close()
        if not self.live:
            how = "done" if task.finished else f"stopped at {task.completed}"
            self._say(_joined(f"{task.description}: {how} {spent}", self.numbers))

    def _say(self, line: str) -> None:
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


def about(seconds: float) -> str:
    """As precise as an estimate is."""
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
