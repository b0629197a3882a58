"""Progress of long work on the standard error stream: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

_WINDOW_SECONDS = 20.0  # the speed shown is that of so much of the recent past
_REFRESH_SECONDS = 0.25


def reporter(console: Console | None = None, every: float = 10.0) -> LiveLine | PlainLines:
    """For the standard error stream (or `console`): a live line, or plain ones `every` so many seconds."""
    console = console or Console(stderr=True)
    return LiveLine(console) if console.is_terminal else PlainLines(console, every)


class Speed:
    """Iterations per second over the recent past, and the time that is left at that speed."""

    def __init__(self, iterations: int, iteration: int, now: float) -> None:
        self.iterations = iterations
        self.marks: deque[tuple[float, int]] = deque([(now, iteration)])
        self.begun = False

    def note(self, iteration: int, now: float) -> None:
        if not self.begun:  # the first step may have compiled things: it tells nothing of the speed
            self.begun = True
            self.marks.clear()
        self.marks.append((now, iteration))
        while len(self.marks) > 2 and self.marks[1][0] < now - _WINDOW_SECONDS:
            self.marks.popleft()

    @property
    def rate(self) -> float | None:
        """Iterations per second; None before there is anything to tell it from."""
        (start, first), (end, last) = self.marks[0], self.marks[-1]
        return (last - first) / (end - start) if end > start and last > first else None

    def text(self) -> str:
        """For example `8.1 it/s, 5:02 left`."""
        rate = self.rate
        if rate is None:
            return "starting"
        left = (self.iterations - self.marks[-1][1]) / rate
        return f"{rate:.1f} it/s, {clock(left)} left"


class LiveLine:
    """A line redrawn in place, from `update`: no thread that training would share its cores with."""

    def __init__(self, console: Console, timer: Callable[[], float] = time.monotonic) -> None:
        self.console = console
        self.timer = timer
        self.live: Live | None = None

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.title = title
        self.iterations = iterations
        self.iteration = iteration
        self.description = ""
        self.started = self.drawn = self.timer()
        self.speed = Speed(iterations, iteration, self.started)
        self.live = Live(self._line(self.speed.text()), console=self.console, auto_refresh=False)
        self.live.start(refresh=True)

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        now = self.timer()
        self.speed.note(iteration, now)
        self.iteration = iteration
        self.description = describe(gaussians, numbers)
        if self.live is not None and now - self.drawn >= _REFRESH_SECONDS:
            self.drawn = now
            self.live.update(self._line(self.speed.text()), refresh=True)

    def finish(self) -> None:
        if self.live is not None:
            self.live.update(self._line(f"in {clock(self.timer() - self.started)}"), refresh=True)
            self.live.stop()
            self.live = None

    def _line(self, pace: str) -> Table:
        """Title and bar, then text that wraps beside them where the terminal is narrow."""
        numbers = ", ".join(filter(None, [pace, self.description]))
        line = Table.grid(padding=(0, 1))
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True)
        line.add_column()
        bar = ProgressBar(total=self.iterations, completed=self.iteration, width=12)
        line.add_row(Text(self.title), bar, Text(f"{self.iteration}/{self.iterations} {numbers}"))
        return line


class PlainLines:
    """A line now and then, for logs."""

    def __init__(self, console: Console, every: float, timer: Callable[[], float] = time.monotonic) -> None:
        self.console = console
        self.every = every
        self.timer = timer
        self.running = False

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.title = title
        self.iterations = iterations
        self.speed = Speed(iterations, iteration, self.timer())
        self.said = self.timer()
        self.started = self.timer()
        self.last = (iteration, "")
        self.running = True
        where = f", continuing at {iteration}" if iteration else ""
        self._say(f"{title}: {iterations} steps{where}")

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        now = self.timer()
        self.speed.note(iteration, now)
        self.last = (iteration, describe(gaussians, numbers))
        if now - self.said >= self.every:
            self.said = now
            facts = ", ".join(filter(None, [self.speed.text(), self.last[1]]))
            self._say(f"{self.title}: {iteration}/{self.iterations}, {facts}")

    def finish(self) -> None:
        if not self.running:
            return
        self.running = False
        iteration, description = self.last
        how = "done" if iteration >= self.iterations else f"stopped at {iteration}"
        spent = clock(self.timer() - self.started)
        self._say(", ".join(filter(None, [f"{self.title}: {how} in {spent}", description])))

    def _say(self, line: str) -> None:
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


def describe(gaussians: int, numbers: dict[str, float]) -> str:
    """For example `12,345 Gaussians, PSNR cover 25.13, PSNR secret 22.40`; empty where there are none."""
    count = [f"{gaussians:,} Gaussians"] if gaussians else []
    return ", ".join(count + [f"{name} {value:.2f}" for name, value in numbers.items()])


def clock(seconds: float) -> str:
    """`m:ss` or `h:mm:ss`."""
    whole = max(0, round(seconds))
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
