"""Several plain models at the same time, each in a process of its own with its share of the threads.

A training step is many short pieces of work, and the second of two threads waits for half of them: two
trainings of one thread each take less time than one after the other with both (docs/scaling.md). The models
are the same to the bit, for they do not depend on the number of threads. Threads of one process would wait
for Python's lock.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType

import torch

from keyss import _processes
from keyss.core.errors import Interrupted, KeyssWarning, OtherProcessError, signal_of
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting import loop
from keyss.fitting.checkpoint import steps_done
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import ENDING, REMEDY, deferred
from keyss.fitting.plain import fit_scene
from keyss.fitting.ranks import here
from keyss.fitting.reporting import Reporter, SeveralReporter, SilentReporter

MIN_STEPS = 1000  # of a training that is worth the two seconds that a process takes to start

_PROCESS_BYTES = 500 << 20  # libraries, and the pictures of a step
_COPIES = 16  # numbers that a training holds for one of a model: moments, gradients, what a step makes
_POLL = 0.1  # seconds between looks at what processes report, and between two reports of one


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
    """Their models, as `fit_scene` gives them, with its errors; at the same time where `at_once` allows it.

    One after the other where a reporter cannot follow several, or where no process can be started, with a
    KeyssWarning. On Ctrl-C, and where one fails, those that have begun save their checkpoints. Raises
    OtherProcessError where the process of one is killed.
    """
    followed = all(fit.reporter is None or isinstance(fit.reporter, SeveralReporter) for fit in fits)
    if followed and (size := at_once(fits, torch.device(device))) > 1:
        try:
            return _fit_in_processes(fits, size, resume)
        except _NoProcessError as error:
            reason = f"fits run one after the other, for no process could be started for them: {error}"
            warnings.warn(reason, KeyssWarning, stacklevel=2)
    return [_fitted(fit, device, resume) for fit in fits]


def at_once(fits: Sequence[Fit], device: torch.device) -> int:
    """How many are fitted at the same time; 1: they are fitted one after the other.

    On a CPU, as many as have MIN_STEPS, and as there are threads, cores and memory for. One where several
    processes train together (torchrun), and where no processes can be started.
    """
    long = [fit for fit in fits if fit.config.iterations >= MIN_STEPS]
    if len(long) < 2 or device.type != "cpu" or here().count > 1 or not _processes.can_start():
        return 1
    size = min(len(long), torch.get_num_threads(), _processes.usable_cores())
    if (available := _processes.available_memory()) is not None:
        size = min(size, available // max(map(process_bytes, long)))
    return max(1, size)


def process_bytes(fit: Fit) -> int:
    """Memory that the process of a fit takes, roughly."""
    pictures = [each for view in fit.scene.views for each in (view.image, view.drawn) if each is not None]
    numbers = fit.config.max_gaussians * (11 + 3 * (fit.config.sh_degree + 1) ** 2)
    return _PROCESS_BYTES + sum(each.nbytes for each in pictures) + 4 * _COPIES * numbers


def _fitted(fit: Fit, device: torch.device | str, resume: bool) -> Gaussians:
    return fit_scene(
        fit.scene,
        fit.config,
        device=device,
        title=fit.title,
        checkpoint=fit.checkpoint,
        resume=resume,
        reporter=fit.reporter,
    ).gaussians


class _NoProcessError(Exception):
    """No process can be started, or one ends before it has loaded what it needs."""


def _fit_in_processes(fits: Sequence[Fit], size: int, resume: bool) -> list[Gaussians]:
    """The models of fits, of which `size` run at the same time.

    Raises _NoProcessError, the first error of a fit, or Interrupted.
    """
    error: BaseException | None = None
    with deferred(saves=any(fit.checkpoint for fit in fits)) as interrupted, closing(_Pool(size)) as pool:
        try:
            for fit in fits:
                pool.submit(fit, resume)
        except (OSError, BrokenProcessPool) as failed:
            error = _NoProcessError(failed)
        for fit, reporter in zip(fits, pool.reporters.values(), strict=False):
            reporter.start(fit.title, fit.config.iterations, steps_done(fit.checkpoint) if resume else 0)
        while pool.reporters and error is None and not interrupted():
            error = pool.look()
        if error is not None or interrupted():
            pool.stop()
        if isinstance(error, BrokenProcessPool):
            error = pool.cause(fits)
        # A signal may have come to the processes as well, and says more than how they ended.
        signum = interrupted() or (signal_of(error) if isinstance(error, Interrupted) else None)
        if signum is not None:
            saved = [fit.checkpoint for fit in fits if fit.checkpoint and fit.checkpoint.exists()]
            raise Interrupted(saved[0] if saved else None, None, signum)
        if error is not None:
            raise error
        return [pickle.loads(future.result()) for future in pool.futures]


class _Pool:
    """Processes that fit plain models, and what they report. Raises _NoProcessError."""

    def __init__(self, size: int) -> None:
        self.others = multiprocessing.active_children()
        self.processes: list[BaseProcess] = []
        self.futures: list[Future[bytes]] = []
        self.reporters: dict[int, Reporter] = {}  # of the fits that have not ended
        self.fit_of: dict[int | None, int] = {}  # by process, the last that it reported; 0 before the first
        context = multiprocessing.get_context("spawn")
        try:
            # The system writes messages this short as a whole: a killed process can keep no lock.
            self.reports, sender = context.Pipe(duplex=False)
            self.executor = ProcessPoolExecutor(size, context, _begin, (sender, _threads(size)))
        except OSError as error:
            raise _NoProcessError(error) from error

    def submit(self, fit: Fit, resume: bool) -> None:
        """Raises OSError and BrokenProcessPool."""
        reporter = fit.reporter or SilentReporter()
        if self.futures and isinstance(reporter, SeveralReporter):
            reporter = reporter.beside()
        # As bytes, for the pool would move tensors to shared memory, of which there may be little.
        task = pickle.dumps((replace(fit, reporter=None), resume, len(self.futures), reporter.loss_every))
        with _as_child():
            future = self.executor.submit(_fit, task)
        self.processes = [each for each in multiprocessing.active_children() if each not in self.others]
        self.reporters[len(self.futures)] = reporter
        self.futures.append(future)

    def look(self) -> BaseException | None:
        """Pass on what is reported within a tenth of a second; the error of a fit that has ended, if any."""
        wait([self.futures[index] for index in self.reporters], _POLL, FIRST_COMPLETED)
        ended = [index for index in self.reporters if self.futures[index].done()]
        while self.reports.poll():
            pid, index, *report = self.reports.recv()
            self.fit_of[pid] = index
            if report and index in self.reporters:
                self.reporters[index].update(*report)
        for index in ended:
            self.reporters.pop(index).finish()
        errors = [error for index in ended if (error := self.futures[index].exception()) is not None]
        if not errors and any(each.exitcode is not None for each in self.processes):
            return BrokenProcessPool()  # which does not always notice by itself
        # Where a process ends, so do all fits that are left.
        return min(errors, key=lambda error: isinstance(error, BrokenProcessPool), default=None)

    def stop(self) -> None:
        """Have all save and end, and wait for it. What has not begun has nothing to save."""
        self.executor.shutdown(wait=False)
        for each in self.processes:
            each.terminate()
        for each in self.processes:
            while each.exitcode is None:
                each.join(_POLL)

    def cause(self, fits: Sequence[Fit]) -> Exception | Interrupted:
        """Why a process has ended that was not told to; all have, for the others were told then."""
        first = min(self.processes, key=lambda each: _signal_of(each) is not None, default=None)
        if first is not None and (signum := _signal_of(first)):
            return Interrupted(None, None, signum)
        if first is None or first.pid not in self.fit_of:
            return _NoProcessError("one has ended while it was loading")
        fit, status = fits[self.fit_of[first.pid]], first.exitcode or 0
        there = fit.checkpoint is not None and fit.checkpoint.exists()
        said = f"the process for the {fit.title} has ended ({_processes.how_it_ended(status)}); "
        said += REMEDY if there else "nothing was saved"
        if status == -signal.SIGKILL:  # as systems do that are short of memory
            said += "; with OMP_NUM_THREADS=1 in the environment fits need less memory, one after the other"
        return OtherProcessError(said)

    def close(self) -> None:
        """Leave nothing of the processes, whatever they do."""
        for each in self.processes:
            each.kill()
            each.join()
        self.executor.shutdown()
        for reporter in self.reporters.values():
            reporter.finish()


def _threads(processes: int) -> int:
    """That each process may use."""
    return max(1, torch.get_num_threads() // processes)


def _signal_of(process: BaseProcess) -> signal.Signals | None:
    """The signal that a process has ended for: killed by it, or with the exit status that says so."""
    return next((each for each in ENDING if process.exitcode in (-each, 128 + each)), None)


@contextmanager
def _as_child() -> Iterator[None]:
    """What a process inherits that starts here.

    Ctrl-C comes to all processes of a terminal, and this one says what is to be done. The program that runs
    here is not imported again, for it may do all its work when it is imported.
    """
    main, variables = sys.modules["__main__"], dict(os.environ)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        sys.modules["__main__"] = ModuleType("__main__")
        os.environ["PYTHONSAFEPATH"] = "1"  # nothing is imported from the folder that this is started in
        os.environ.pop("KEYSS_KEY", None)
        yield
    finally:
        os.environ.clear()
        os.environ.update(variables)
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(sender: Connection, threads: int) -> None:
    """Prepare a process, which ends with the one that started it."""
    loop.patient = True
    _Sender.pipe = sender
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sender.send((os.getpid(), 0))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(128 + signal.SIGHUP)  # nothing is lost, for a checkpoint appears when it is whole


def _fit(task: bytes) -> bytes:
    """The model of a fit; the process ends where the training is interrupted."""
    fit, resume, index, loss_every = pickle.loads(task)
    try:
        return pickle.dumps(_fitted(replace(fit, reporter=_Sender(index, loss_every)), "cpu", resume))
    except Interrupted as interrupt:
        os._exit(128 + signal_of(interrupt))


class _Sender(SilentReporter):
    """Tells the other process."""

    pipe: Connection

    def __init__(self, index: int, loss_every: int) -> None:
        self.index, self.loss_every = index, loss_every
        self.sent, self.numbers = 0.0, dict[str, float]()

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.iterations = iterations

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        now = time.monotonic()
        if numbers != self.numbers or iteration == self.iterations or now - self.sent >= _POLL:
            self.sent, self.numbers = now, dict(numbers)
            self.pipe.send((os.getpid(), self.index, iteration, gaussians, self.numbers))
