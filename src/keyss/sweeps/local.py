"""The engine of one machine: a process for each job, a few at once."""

from __future__ import annotations

import contextlib
import subprocess
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from keyss._processes import how_it_ended
from keyss.sweeps.engine import RETRIES, WORKER, Resources, Task, Watcher, process_of
from keyss.sweeps.worker import REFUSED

_POLL = 0.05  # s
_PATIENCE = 20.0  # s for jobs to save what they have when they are interrupted


@dataclass(frozen=True)
class LocalEngine:
    """Processes of this machine."""

    resources: Resources
    retries: int = RETRIES
    command: Sequence[str] = WORKER

    def run(self, tasks: Sequence[Task], watcher: Watcher) -> None:
        """See `Engine`. Interrupted, it interrupts what runs, and waits until that has saved its state."""
        waiting = deque((task, 0) for task in tasks)  # with the number of attempts before
        running: list[tuple[Task, int, subprocess.Popen[bytes]]] = []
        try:
            while waiting or running:
                while waiting and len(running) < self.resources.jobs:
                    task, before = waiting.popleft()
                    watcher.started(task)
                    running.append((task, before, self._start(task)))
                time.sleep(_POLL)
                watcher.tick()
                for each in [each for each in running if each[2].poll() is not None]:
                    running.remove(each)
                    task, before, process = each
                    _close(process)
                    status = process.returncode
                    if status == 0:
                        watcher.done(task)
                    elif status == REFUSED:
                        watcher.refused(task)
                    else:
                        again = before < self.retries
                        watcher.died(task, how_it_ended(status), again)
                        if again:
                            waiting.append((task, before + 1))
        finally:
            _interrupt([process for *_, process in running])

    def _start(self, task: Task) -> subprocess.Popen[bytes]:
        return process_of(task.folder, self.resources.threads, self.command)


def _interrupt(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Ends processes, which may save their state before."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + _PATIENCE
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        _close(process)


def _close(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
