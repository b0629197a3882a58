"""Several plain models at the same time, each in a process of its own with its share of the threads.

A training step is many short pieces of work, and the second of two threads waits for half of them: two
trainings of one thread each take less time than one after the other with both (docs/scaling.md). What comes
out is the same to the bit, for it does not depend on the number of threads. Processes, because threads of one
process would wait for Python's lock.
"""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch

from keyss import _processes
from keyss.core import errors
from keyss.core.errors import InputError, Interrupted, KeyssError, OtherProcessError, signal_of
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting import worker
from keyss.fitting.checkpoint import State, load_checkpoint
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import REMEDY, Reporter, SeveralReporter, SilentReporter, deferred
from keyss.fitting.plain import fit_scene
from keyss.fitting.ranks import here

LEAST_STEPS = 1000  # of a training, for which a process is worth the two seconds that it takes to start
SIDE_BY_SIDE = 0.75  # of the time that two trainings take one after the other: see docs/scaling.md

_PROCESS_BYTES = 500 << 20  # libraries, and the pictures of a step
_COPIES = 16  # numbers that a training holds for one of a model: moments, gradients, what a step makes
_POLL = 0.1  # seconds
_ALONE = "with OMP_NUM_THREADS=1 in the environment fits are one after the other, which takes less memory"


@dataclass(frozen=True)
class Fit:
    """A plain model that is to be fitted: arguments of `fit_scene`."""

    scene: Scene
    config: FitConfig
    title: str
    checkpoint: Path | None = None
    reporter: Reporter | None = None


def fit_scenes(
    fits: Sequence[Fit], *, device: torch.device | str = "cpu", resume: bool = False
) -> list[Gaussians]:
    """Their models, as `fit_scene` gives them and with its errors; at the same time where `at_once` says so.

    One after the other where a reporter cannot be told of several. On Ctrl-C all save their checkpoints.
    Where one fails or its process is killed (OtherProcessError), the others save theirs.
    """
    found: dict[int, Gaussians] = {}
    done = [_done(fit) if resume else 0 for fit in fits]
    long = [index for index, fit in enumerate(fits) if fit.config.iterations - done[index] >= LEAST_STEPS]
    if all(fit.reporter is None or isinstance(fit.reporter, SeveralReporter) for fit in fits):
        size = at_once([fits[index] for index in long], torch.device(device))
        if size > 1:
            asked = [(fits[index], done[index]) for index in long]
            found = dict(zip(long, _fit_in_processes(asked, size, resume), strict=True))
    for index, fit in enumerate(fits):
        if index not in found:
            found[index] = fit_scene(
                fit.scene,
                fit.config,
                device=device,
                title=fit.title,
                checkpoint=fit.checkpoint,
                resume=resume,
                reporter=fit.reporter,
            ).gaussians
    return [found[index] for index in range(len(fits))]


def at_once(fits: Sequence[Fit], device: torch.device) -> int:
    """How many of them are fitted at the same time: 1 where that is not possible or does not pay.

    On a CPU, as many as there are threads and memory for.
    """
    if (
        len(fits) < 2
        or device.type != "cpu"
        or here().count > 1
        or not sys.executable
        or min(fit.config.iterations for fit in fits) < LEAST_STEPS
    ):
        return 1
    most = min(len(fits), torch.get_num_threads(), _processes.usable_cores())
    if (there := _processes.available_memory()) is not None:
        most = min(most, there // max(map(process_bytes, fits)))
    return max(1, most)


def process_bytes(fit: Fit) -> int:
    """Memory that the process of a fit takes, roughly."""
    pictures = [each for view in fit.scene.views for each in (view.image, view.drawn) if each is not None]
    numbers = fit.config.max_gaussians * (11 + 3 * (fit.config.sh_degree + 1) ** 2)
    return _PROCESS_BYTES + sum(each.nbytes for each in pictures) + 4 * _COPIES * numbers


def _done(fit: Fit) -> int:
    """Steps that its checkpoint has; 0 without one, or with one that the fit will refuse."""
    try:
        if fit.checkpoint is not None and fit.checkpoint.exists():
            return int(load_checkpoint(fit.checkpoint)[1]["iteration"])
    except (InputError, KeyError):
        pass
    return 0


@dataclass
class _Child:
    """A fit in a process of its own."""

    fit: Fit
    reporter: Reporter
    process: subprocess.Popen[bytes]
    model: Gaussians | None = None
    reporting: bool = True
    writing: threading.Lock = field(default_factory=threading.Lock)

    @staticmethod
    def start(fit: Fit, done: int, reporter: Reporter, threads: int) -> _Child:
        """One that goes on after `done` steps, with so many threads. Raises OtherProcessError."""
        try:
            process = subprocess.Popen(
                _processes.command(worker.MODULE),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=_processes.environment(threads),
                start_new_session=True,  # Ctrl-C in a terminal reaches whoever starts it, who passes it on
            )
        except OSError as error:
            reason = error.strerror or str(error)
            raise OtherProcessError(f"no process for the {fit.title} ({reason}); {_ALONE}") from error
        reporter.start(fit.title, fit.config.iterations, done)
        return _Child(fit, reporter, process)

    def talk(self, resume: bool, told: queue.SimpleQueue[_Heard]) -> None:
        """Say what to do, and pass on what it tells, then None; on a thread of its own."""
        order = worker.Order(
            train=len(self.fit.scene.train),
            test=len(self.fit.scene.test),
            config=self.fit.config,
            title=self.fit.title,
            checkpoint=None if self.fit.checkpoint is None else str(self.fit.checkpoint),
            resume=resume,
            loss_every=self.reporter.loss_every,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            with self.writing:
                worker.send_order(self.process.stdin, order, self.fit.scene)
            while (message := worker.receive(self.process.stdout)) is not None:
                told.put((self, *message))
        except OSError:  # it has ended, and its exit status says how
            pass
        finally:
            told.put((self, None, {}))

    def share(self, threads: int) -> None:
        """Have it compute with so many threads from now on."""
        assert self.process.stdin is not None
        with self.writing, suppress(OSError):
            worker.send(self.process.stdin, worker.Threads(threads))

    def finish(self) -> None:
        """Nothing more is reported."""
        if self.reporting:
            self.reporting = False
            self.reporter.finish()

    def close(self) -> None:
        """Nothing is left of the process, however far it was; its thread has ended."""
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            with suppress(OSError):
                pipe.close()
        self.finish()


_Heard = tuple[_Child, worker.Told | None, State]


def _fit_in_processes(asked: Sequence[tuple[Fit, int]], size: int, resume: bool) -> list[Gaussians]:
    """The models of fits, of which `size` run at the same time. Raises the first error, or Interrupted.

    `asked`: with steps that are done already.
    """
    fits = [fit for fit, _ in asked]
    told: queue.SimpleQueue[_Heard] = queue.SimpleQueue()
    waiting = deque((*each, reporter) for each, reporter in zip(asked, _reporters(fits), strict=True))
    running: list[_Child] = []
    children: list[_Child] = []  # those, and those that have ended
    threads: list[threading.Thread] = []
    error: Exception | Interrupted | None = None
    try:
        with deferred(saves=any(fit.checkpoint is not None for fit in fits)) as interrupted:
            while running or (waiting and error is None):
                while waiting and error is None and len(running) < size:
                    child = _Child.start(*waiting.popleft(), _share(size))
                    children.append(child)
                    running.append(child)
                    threads.append(threading.Thread(target=child.talk, args=(resume, told), daemon=True))
                    threads[-1].start()
                found: Exception | Interrupted | None = None
                try:
                    child, message, tensors = told.get(timeout=_POLL)
                except queue.Empty:
                    pass
                else:
                    found = _hear(child, message, tensors)
                    if message is None:
                        running.remove(child)
                        for each in running if not waiting else ():
                            each.share(_share(len(running)))
                if found is None and (signum := interrupted()):
                    found = Interrupted(None, None, signum)
                if error is None and found is not None:
                    error = found
                    for each in running:  # saves its state, and ends
                        each.process.terminate()
            if isinstance(error, Interrupted):
                saved = [fit.checkpoint for fit in fits if fit.checkpoint and fit.checkpoint.exists()]
                error = Interrupted(saved[0] if saved else None, None, signal_of(error))
            if error is not None:
                raise error
    finally:
        for child in children:
            child.process.kill()
            child.process.wait()
        for thread in threads:
            thread.join()
        for child in children:
            child.close()
    return [child.model for child in children if child.model is not None]


def _reporters(fits: Sequence[Fit]) -> list[Reporter]:
    """For trainings at the same time."""
    found: list[Reporter] = []
    for fit in fits:
        reporter = fit.reporter or SilentReporter()
        found.append(reporter.beside() if found and isinstance(reporter, SeveralReporter) else reporter)
    return found


def _share(processes: int) -> int:
    """Threads of each."""
    return max(1, torch.get_num_threads() // processes)


def _hear(child: _Child, told: worker.Told | None, tensors: State) -> Exception | Interrupted | None:
    """Pass on what a process tells; None where it has ended. What all fits are to be stopped for."""
    match told:
        case worker.Progress(iteration, gaussians, numbers):
            child.reporter.update(iteration, gaussians, numbers)
        case worker.Fitted():
            child.model = Gaussians(**tensors)
            child.finish()
        case worker.Stopped():  # as it was told to, or by a signal that nothing else got
            return Interrupted(None, None, signal.SIGTERM)
        case worker.Failed(name, message):
            return _error(name, message)
        case None if child.model is None:
            how = _processes.how_it_ended(child.process.wait())
            saved = "nothing was saved" if child.fit.checkpoint is None else REMEDY
            return OtherProcessError(f"the process of the {child.fit.title} ended ({how}); {saved}; {_ALONE}")
    return None


def _error(name: str, message: str) -> Exception:
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, KeyssError):
        return kind(message)
    return MemoryError(message)
