"""What is shown of jobs while they run: in a terminal a table that is redrawn, elsewhere a line for each."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from keyss import progress
from keyss.progress import clock
from keyss.sweeps.engine import Task
from keyss.sweeps.job import LOG, failure_of

_EVERY = 0.5  # s between two drawings
_MOST_ROWS = 20


class Board:
    """A `Watcher` on the standard error stream."""

    def __init__(self, title: str, total: int, skipped: int, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True, quiet=progress.level < 0)
        self.title, self.total, self.skipped = title, total, skipped
        self.running: dict[Task, float] = {}
        self.ended, self.refused_count, self.lost, self.drawn = 0, 0, 0, 0.0
        self.start = time.monotonic()
        self.live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None

    def __enter__(self) -> Self:
        if self.live:
            self.live.start()
        if self.skipped:
            self._say(f"{self.title}: {self.skipped} of {self.total} are done already")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.live:
            self.live.update(self._table(), refresh=True)
            self.live.stop()

    def started(self, task: Task) -> None:
        self.running[task] = time.monotonic()

    def died(self, task: Task, how: str, again: bool) -> None:
        self.running.pop(task, None)
        self.lost += not again
        what = "it is tried again" if again else f"given up; its last words are in {task.folder / LOG}"
        self._say(f"{task.name}: its process died ({how}): {what}")

    def done(self, task: Task) -> None:
        self.ended += 1
        self._say(f"{task.name}: done in {clock(self._age(task))}")

    def refused(self, task: Task) -> None:
        self.refused_count += 1
        failure = failure_of(task.folder)
        self._say(f"{task.name}: failed: {failure.message if failure else 'no reason was given'}")
        self._age(task)

    def tick(self) -> None:
        if self.live and time.monotonic() - self.drawn > _EVERY:
            self.drawn = time.monotonic()
            self.live.update(self._table(), refresh=True)

    def _age(self, task: Task) -> float:
        return time.monotonic() - self.running.pop(task, time.monotonic())

    def _say(self, line: str) -> None:
        whole = f"[{self.skipped + self.ended + self.refused_count + self.lost}/{self.total}] {line}"
        self.console.print(whole, markup=False, highlight=False, soft_wrap=True)

    def _table(self) -> Table:
        left = self.total - self.skipped - self.ended - self.refused_count - self.lost - len(self.running)
        table = Table(
            title=Text(f"{self.title}, {clock(time.monotonic() - self.start)}"), title_justify="left"
        )
        for name in ("done", "running", "failed", "died", "waiting"):
            table.add_column(name, justify="right")
        counts = (self.skipped + self.ended, len(self.running), self.refused_count, self.lost, max(0, left))
        table.add_row(*map(str, counts))
        outer = Table.grid()
        outer.add_row(table)
        for task, since in list(self.running.items())[:_MOST_ROWS]:
            outer.add_row(Text(f"  {clock(time.monotonic() - since)}  {task.name}"))
        return outer
