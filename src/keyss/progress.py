"""Progress of long work on the standard error stream: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn
from rich.table import Column

_REFRESH_SECONDS = 0.25


def reporter(console: Console | None = None, every: float = 10.0) -> LiveLine | PlainLines:
    """For the standard error stream (or `console`): a live line, or plain ones `every` so many seconds."""
    console = console or Console(stderr=True)
    return LiveLine(console) if console.is_terminal else PlainLines(console, every)


class _Lines:
    """A `Reporter` on a task of rich, which knows the speed of the recent past and the time that is left.

    It draws from `update`: no thread that training would share its cores with.
    """

    live: bool

    def __init__(self, console: Console, every: float, timer: Callable[[], float] = time.monotonic) -> None:
        self.console = console
        self.every = every
        self.timer = timer
        self.task: Task | None = None

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn(
                "{task.fields[facts]}", markup=False, table_column=Column()
            ),  # wraps where it is narrow
            console=self.console,
            auto_refresh=False,
            disable=not self.live,
            get_time=self.timer,
        )
        self.progress.add_task(title, total=iterations, completed=iteration, facts="starting")
        self.task = self.progress.tasks[0]
        self.shown, self.numbers = self.timer(), ""
        self._begin(self.task)

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.task is None:
            return
        self.progress.update(self.task.id, completed=iteration)
        self.numbers = describe(gaussians, numbers)
        if self.timer() - self.shown >= self.every:
            self.shown = self.timer()
            self._show(self.task, _joined(_pace(self.task), self.numbers))

    def finish(self) -> None:
        if self.task is not None:
            self._end(self.task, f"in {clock(self.task.elapsed or 0)}")
            self.task = None

    def _begin(self, task: Task) -> None: ...

    def _show(self, task: Task, facts: str) -> None: ...

    def _end(self, task: Task, spent: str) -> None: ...


class LiveLine(_Lines):
    """A line redrawn in place."""

    live = True

    def __init__(self, console: Console, timer: Callable[[], float] = time.monotonic) -> None:
        super().__init__(console, _REFRESH_SECONDS, timer)

    def _begin(self, task: Task) -> None:
        self.progress.start()

    def _show(self, task: Task, facts: str) -> None:
        self.progress.update(task.id, facts=facts, refresh=True)

    def _end(self, task: Task, spent: str) -> None:
        self._show(task, _joined(spent, self.numbers))
        self.progress.stop()


class PlainLines(_Lines):
    """A line now and then, for logs."""

    live = False

    def _begin(self, task: Task) -> None:
        where = f", continuing at {task.completed}" if task.completed else ""
        self._say(f"{task.description}: {task.total} steps{where}")

    def _show(self, task: Task, facts: str) -> None:
        self._say(f"{task.description}: {task.completed}/{task.total}, {facts}")

    def _end(self, task: Task, spent: str) -> None:
        how = "done" if task.finished else f"stopped at {task.completed}"
        self._say(_joined(f"{task.description}: {how} {spent}", self.numbers))

    def _say(self, line: str) -> None:
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


def describe(gaussians: int, numbers: dict[str, float]) -> str:
    """For example `12,345 Gaussians, PSNR cover 25.13, PSNR secret 22.40`; empty where there are none."""
    count = f"{gaussians:,} Gaussians" if gaussians else ""
    return _joined(count, *(f"{name} {value:.2f}" for name, value in numbers.items()))


def clock(seconds: float) -> str:
    """`m:ss` or `h:mm:ss`."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _pace(task: Task) -> str:
    """For example `8.1 it/s, 5:02 left`."""
    return f"{task.speed:.1f} it/s, {clock(task.time_remaining or 0)} left" if task.speed else "starting"


def _joined(*facts: str) -> str:
    return ", ".join(filter(None, facts))
