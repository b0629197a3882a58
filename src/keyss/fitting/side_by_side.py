"""Several plain models at the same time, each in a process of its own with its share of the threads.

A training step is many short pieces of work, and the second of two threads waits for half of them: two
trainings of one thread each take less time than one after the other with both (docs/scaling.md). The models
do not depend on the number of threads: they are equal to the bit. Threads of one process would wait for
Python's lock.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import subprocess
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from pathlib import Path

import torch

from keyss import _processes
from keyss._interrupts import ENDING
from keyss.core.errors import Interrupted, KeyssWarning, OtherProcessError, signal_of
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.checkpoint import steps_done
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import REMEDY, deferred
from keyss.fitting.losses import Targets
from keyss.fitting.plain import fit_scene
from keyss.progress import Reporter

MIN_STEPS = 1000  # shorter trainings are not worth the two seconds that a process takes to start
POLL = 0.1  # seconds between checks for signals, and between two progress reports of one process

_PROCESS_BYTES = 500 << 20  # libraries, and the images of a step
_COPIES = 16  # numbers in training for each number of a model: moments, gradients, intermediate results
_EXIT_SECONDS = 5.0  # for a process to exit after it has sent its model


@dataclass(frozen=True)
class Fit:
    """Arguments of `fit_scene` for one plain model."""

    scene: Scene
    config: FitConfig
    title: str
    checkpoint: Path | None = None
    reporter: Reporter | None = None


def fit_scenes(
    fits: Sequence[Fit], *, device: torch.device | str = "cpu", resume: bool = False
) -> list[Gaussians]:
    """The models that `fit_scene` gives, with its errors; fitted at the same time where `at_once` allows it.

    They are fitted one after the other if a reporter cannot follow several, and, with a KeyssWarning, if no
    process can be started. On Ctrl-C and on errors, running fits save their checkpoints. Raises
    OtherProcessError if a process is killed.
    """
    followed = all(fit.reporter is None or fit.reporter.several for fit in fits)
    if followed and (size := at_once(fits, torch.device(device))) > 1:
        try:
            return _fit_in_processes(fits, size, resume)
        except _NoProcessError as error:
            reason = f"fits run one after the other, because no process could be started: {error}"
            warnings.warn(reason, KeyssWarning, stacklevel=2)
    return [fitted(fit, device, resume) for fit in fits]


def at_once(fits: Sequence[Fit], device: torch.device) -> int:
    """The number of fits that run at the same time; 1 for one after the other.

    On a CPU, it is limited by the fits of at least MIN_STEPS, threads, cores and memory. It is 1 where
    no process can be started.
    """
    long = [fit for fit in fits if fit.config.iterations >= MIN_STEPS]
    if len(long) < 2 or device.type != "cpu" or not _processes.can_start():
        return 1
    size = min(len(long), torch.get_num_threads(), _processes.usable_cores())
    if (available := _processes.available_memory()) is not None:
        size = min(size, available // max(map(process_bytes, long)))
    return max(1, size)


def process_bytes(fit: Fit) -> int:
    """Rough memory of the process of a fit."""
    images = [each for view in fit.scene.views for each in (view.image, view.unrounded) if each is not None]
    numbers = fit.config.max_gaussians * (11 + 3 * (fit.config.sh_degree + 1) ** 2)
    pictures = sum(image.nbytes for image in images) + Targets.most_bytes(fit.scene.train)
    return _PROCESS_BYTES + pictures + 4 * _COPIES * numbers


def fitted(fit: Fit, device: torch.device | str, resume: bool) -> Gaussians:
    """The model of one fit, in this process; see `fit_scene`."""
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
    """No process can be started, or one ends before it has loaded its libraries."""


def _fit_in_processes(fits: Sequence[Fit], size: int, resume: bool) -> list[Gaussians]:
    """Run at most `size` fits at the same time.

    Raises _NoProcessError, the first error of a fit, Interrupted, or OtherProcessError.
    """
    threads = max(1, torch.get_num_threads() // size)
    workers: list[_Worker] = []
    models: dict[int, Gaussians] = {}
    with deferred(saves=any(fit.checkpoint for fit in fits)) as interrupted:
        try:
            while len(models) < len(fits):
                running = [index for index in range(len(workers)) if index not in models]
                if len(running) < size and len(workers) < len(fits):
                    workers.append(_Worker(fits[len(workers)], threads, resume, first=not workers))
                    continue
                ready = wait([workers[index].connection for index in running], POLL)
                for index in running:
                    worker = workers[index]
                    if worker.connection in ready and (model := worker.receive()) is not None:
                        models[index] = model
                if signum := interrupted():
                    raise Interrupted(None, None, signum)
        except (Exception, Interrupted) as error:
            for worker in workers:
                worker.process.terminate()
            for worker in workers:
                worker.process.wait()
            # A signal to all processes says more than the exit status of one.
            signum = interrupted() or (signal_of(error) if isinstance(error, Interrupted) else None)
            if signum is None:
                raise
            saved = [fit.checkpoint for fit in fits if fit.checkpoint and fit.checkpoint.exists()]
            raise Interrupted(saved[0] if saved else None, None, signum) from None
        finally:
            for index, worker in enumerate(workers):
                if index not in models:
                    worker.close()
    return [models[index] for index in range(len(fits))]


class _Worker:
    """A process that runs `keyss.fitting.worker`."""

    def __init__(self, fit: Fit, threads: int, resume: bool, *, first: bool) -> None:
        """Raises _NoProcessError."""
        self.fit, self.resume = fit, resume
        self.loaded = False
        self.connection, theirs = multiprocessing.Pipe()
        with theirs:
            try:
                self.process = subprocess.Popen(
                    [*_processes.command("keyss.fitting.worker"), str(theirs.fileno())],
                    stdin=subprocess.PIPE,
                    env=_processes.environment(threads),
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,  # Ctrl-C in a terminal reaches this process only
                )
            except OSError as error:
                self.connection.close()
                raise _NoProcessError(error) from error
        self.reporter = fit.reporter or Reporter()
        if not first:
            self.reporter = self.reporter.beside()
        self.reporter.start(fit.title, fit.config.iterations, steps_done(fit.checkpoint) if resume else 0)

    def receive(self) -> Gaussians | None:
        """Handle one message; the last one is the model.

        Raises the error of the fit, or what `_cause_of_end` returns.
        """
        try:
            message = pickle.loads(self.connection.recv_bytes())
            if message is None:
                self.loaded = True
                task = replace(self.fit, reporter=None), self.resume, self.reporter.loss_every
                self.connection.send_bytes(pickle.dumps(task))
        except (EOFError, OSError):
            raise self._cause_of_end() from None
        match message:
            case Gaussians():
                self.close(_EXIT_SECONDS)
                return message
            case BaseException():
                raise message
            case (iteration, gaussians, numbers):
                self.reporter.update(iteration, gaussians, numbers)
        return None

    def _cause_of_end(self) -> Exception | Interrupted:
        """Why the process has ended without a model."""
        status = self.process.wait()
        for signum in ENDING:
            if status in (-signum, 128 + signum):
                return Interrupted(None, None, signum)
        if not self.loaded:
            return _NoProcessError("it ended while it was loading")
        saved = self.fit.checkpoint is not None and self.fit.checkpoint.exists()
        message = f"the process for the {self.fit.title} has ended ({_processes.how_it_ended(status)}); "
        message += REMEDY if saved else "nothing was saved"
        if status == -signal.SIGKILL:  # systems send it when they run out of memory
            message += (
                "; with OMP_NUM_THREADS=1 in the environment, fits run one after the other and need less"
            )
        return OtherProcessError(message)

    def close(self, patience: float = 0.0) -> None:
        """End the process, `patience` seconds from now at the latest."""
        with self.process, self.connection:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(patience)
            self.process.kill()
        self.reporter.finish()
