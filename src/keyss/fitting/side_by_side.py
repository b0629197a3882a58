"""Several plain models at the same time, each in a process of its own with its share of the threads.

A training step is many short pieces of work, and the second of two threads waits for half of them: two
trainings of one thread each take less time than one after the other with both (docs/scaling.md). What comes
out is the same to the bit, for it does not depend on the number of threads. Processes, because threads of one
process would wait for Python's lock.
"""

from __future__ import annotations

import builtins
import os
import queue
import signal
import subprocess
import threading
import warnings
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch

from keyss import _processes
from keyss.core import errors
from keyss.core.errors import Interrupted, KeyssWarning, OtherProcessError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting import worker
from keyss.fitting.checkpoint import State, steps_done
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import ENDING, REMEDY, Reporter, SeveralReporter, SilentReporter, deferred
from keyss.fitting.plain import fit_scene
from keyss.fitting.ranks import here

LEAST_STEPS = 1000  # of a training, for which a process is worth the two seconds that it takes to start
SIDE_BY_SIDE = 0.75  # of the time that two trainings take one after the other: see docs/scaling.md

_PROCESS_BYTES = 500 << 20  # libraries, and the pictures of a step
_COPIES = 16  # numbers that a training holds for one of a model: moments, gradients, what a step makes
_POLL = 0.1  # seconds


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

    One after the other where a reporter cannot be told of several, or no process can be started, of which
    KeyssWarning tells. On Ctrl-C, and where one fails, those that have begun save their checkpoints. Raises
    OtherProcessError where the process of one is killed.
    """
    found: dict[int, Gaussians] = {}
    tellable = all(fit.reporter is None or isinstance(fit.reporter, SeveralReporter) for fit in fits)
    if tellable and at_once(fits, torch.device(device)) > 1:
        done = [steps_done(fit.checkpoint) if resume else 0 for fit in fits]
        left = [index for index, fit in enumerate(fits) if fit.config.iterations - done[index] >= LEAST_STEPS]
        if (size := at_once([fits[index] for index in left], torch.device(device))) > 1:
            asked = [(fits[index], done[index]) for index in left]
            try:
                found = dict(zip(left, _fit_in_processes(asked, size, resume), strict=True))
            except _NoProcessError as error:
                said = f"fits are done one after the other, for no process could be started for them: {error}"
                warnings.warn(said, KeyssWarning, stacklevel=2)
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
    """How many of those with LEAST_STEPS are fitted at the same time; 1: they are fitted one after the other.

    On a CPU, as many as there are threads, cores and memory for. One where several processes train together
    (torchrun), and where no processes can be started.
    """
    long = [fit for fit in fits if fit.config.iterations >= LEAST_STEPS]
    if len(long) < 2 or device.type != "cpu" or here().count > 1 or not _processes.can_start():
        return 1
    most = min(len(long), torch.get_num_threads(), _processes.usable_cores())
    if (there := _processes.available_memory()) is not None:
        most = min(most, there // max(map(process_bytes, long)))
    return max(1, most)


def process_bytes(fit: Fit) -> int:
    """Memory that the process of a fit takes, roughly."""
    pictures = [each for view in fit.scene.views for each in (view.image, view.drawn) if each is not None]
    numbers = fit.config.max_gaussians * (11 + 3 * (fit.config.sh_degree + 1) ** 2)
    return _PROCESS_BYTES + sum(each.nbytes for each in pictures) + 4 * _COPIES * numbers


class _NoProcessError(Exception):
    """A process cannot be started, or does not come so far that it could be told what to do."""


@dataclass(eq=False)
class _Child:
    """A fit in a process of its own."""

    fit: Fit
    reporter: Reporter
    process: subprocess.Popen[bytes]
    answers: int  # descriptor, to be read
    model: Gaussians | None = None
    ready: bool = False  # all that it needs is loaded
    begun: bool = False  # has something that can be saved
    reporting: bool = False
    thread: threading.Thread | None = None  # that talks to it
    threads: int | None = None  # for it to compute with, which it is not told yet
    writing: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, order: worker.Order, done: int, heard: queue.SimpleQueue[_Heard]) -> None:
        """Have it go on after `done` steps; what it answers goes to `heard`."""
        thread = threading.Thread(target=self.talk, args=(order, heard), daemon=True)
        thread.start()
        self.thread = thread
        self.reporting = True
        self.reporter.start(self.fit.title, self.fit.config.iterations, done)

    def talk(self, order: worker.Order, heard: queue.SimpleQueue[_Heard]) -> None:
        """Say what to do, and pass on what it answers, in the end why that ends; on a thread of its own."""
        end: Exception | None = None
        try:
            with os.fdopen(self.answers, "rb") as answers:
                assert self.process.stdin is not None
                # It may end before it has read all: its exit status says how.
                with self.writing, suppress(BrokenPipeError):
                    worker.send_order(self.process.stdin, order, self.fit.scene)
                while (found := worker.receive(answers)) is not None:
                    heard.put((self, *found))
        except Exception as error:
            end = error
            self.process.kill()
        heard.put((self, end, {}))

    def say_threads(self) -> None:
        """Pass on their number, unless it is still being told what to do."""
        if self.threads is not None and self.writing.acquire(blocking=False):
            try:
                self._say(worker.Threads(self.threads))
            finally:
                self.threads = None
                self.writing.release()

    def stop(self) -> None:
        """Have it save its state and end. What has not begun has nothing to save."""
        if not self.begun:
            self.process.kill()
            return
        with self.writing:
            self._say(worker.Stop())

    def _say(self, message: worker.Message) -> None:
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):
            worker.send(self.process.stdin, message)

    def finish(self) -> None:
        """Nothing more is reported."""
        if self.reporting:
            self.reporting = False
            self.reporter.finish()

    def end(self) -> None:
        """Leave nothing of the process, whatever it does."""
        self.process.kill()
        self.process.wait()
        if self.thread is not None:
            self.thread.join()
        with suppress(BrokenPipeError):
            assert self.process.stdin is not None
            self.process.stdin.close()
        self.finish()


# What a process answers, or None or an error: nothing more comes.
_Heard = tuple[_Child, worker.Message | Exception | None, State]


def _fit_in_processes(asked: Sequence[tuple[Fit, int]], size: int, resume: bool) -> list[Gaussians]:
    """The models of fits, of which `size` run at the same time. `asked`: with steps that are done already.

    Raises _NoProcessError, the first error of a fit, or Interrupted.
    """
    fits = [fit for fit, _ in asked]
    waiting = deque((*each, reporter) for each, reporter in zip(asked, _reporters(fits), strict=True))
    running: list[_Child] = []
    children: list[_Child] = []  # those, and those that have ended
    heard: queue.SimpleQueue[_Heard] = queue.SimpleQueue()
    error: Exception | Interrupted | None = None
    with ExitStack() as stack, deferred(saves=any(fit.checkpoint for fit in fits)) as interrupted:
        while running or (waiting and error is None):
            while waiting and error is None and len(running) < size:
                try:
                    child = _start(stack, *waiting[0], _share(size), resume, heard)
                except _NoProcessError:
                    if not running:
                        raise
                    size = len(running)  # until one of them has ended
                    break
                waiting.popleft()
                children.append(child)
                running.append(child)
            found: Exception | Interrupted | None = None
            with suppress(queue.Empty):
                child, message, tensors = heard.get(timeout=_POLL)
                found = _hear(child, message, tensors)
                if message is None or isinstance(message, Exception):
                    running.remove(child)
                    for each in () if waiting else running:
                        each.threads = _share(len(running))
            for each in running:
                each.say_threads()
            stopping = error is not None
            # A signal may have come to processes as well, and comes before what they say of it.
            error = Interrupted(None, None, signum) if (signum := interrupted()) else error or found
            if error is not None and not stopping:
                for each in running:
                    each.stop()
        if isinstance(error, Interrupted):
            saved = [fit.checkpoint for fit in fits if fit.checkpoint and fit.checkpoint.exists()]
            raise Interrupted(saved[0] if saved else None, None, errors.signal_of(error))
        if error is not None:
            raise error
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


def _start(
    stack: ExitStack,
    fit: Fit,
    done: int,
    reporter: Reporter,
    threads: int,
    resume: bool,
    heard: queue.SimpleQueue[_Heard],
) -> _Child:
    """A fit that goes on after `done` steps; `stack` ends it. Raises _NoProcessError."""
    answers, theirs = os.pipe()
    # It inherits this: Ctrl-C comes to all processes of a terminal, and this one says what is to be done.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        process = subprocess.Popen(
            [*_processes.command(worker.MODULE), str(theirs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=[theirs],
            env=_processes.environment(threads),
        )
    except OSError as error:
        os.close(answers)
        raise _NoProcessError(error.strerror or str(error)) from error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.close(theirs)
    child = _Child(fit, reporter, process, answers)
    stack.callback(child.end)
    order = worker.Order(
        train=len(fit.scene.train),
        test=len(fit.scene.test),
        config=fit.config,
        title=fit.title,
        checkpoint=None if fit.checkpoint is None else str(fit.checkpoint),
        resume=resume,
        loss_every=reporter.loss_every,
    )
    child.begin(order, done, heard)
    return child


def _hear(
    child: _Child, message: worker.Message | Exception | None, tensors: State
) -> Exception | Interrupted | None:
    """Pass on what a process answers. What all fits are to be stopped for."""
    match message:
        case worker.Ready():
            child.ready = True
        case worker.Progress(iteration, gaussians, numbers):
            child.begun = True
            child.reporter.update(iteration, gaussians, numbers)
        case worker.Fitted():
            child.model = Gaussians(**tensors)
            child.finish()
        case worker.Stopped(signum):  # as it was told to, or by a signal that only it got
            return Interrupted(None, None, signal.Signals(signum))
        case worker.Failed():
            return _error(message)
        case Exception():
            return message
        case None if child.model is None:
            return _end(child)
    return None


def _end(child: _Child) -> Exception | Interrupted:
    """Of a process that has ended without having said why."""
    status = child.process.wait()
    if -status in ENDING:
        return Interrupted(None, None, signal.Signals(-status))
    if not child.ready and status > 0:
        return _NoProcessError(f"{_processes.how_it_ended(status)} while it was loading")
    there = child.fit.checkpoint is not None and child.fit.checkpoint.exists()
    said = f"the process for the {child.fit.title} has ended ({_processes.how_it_ended(status)}); "
    said += REMEDY if there else "nothing was saved"
    if status == -signal.SIGKILL:  # as systems do that are short of memory
        said += "; with OMP_NUM_THREADS=1 in the environment fits need less memory, one after the other"
    return OtherProcessError(said)


def _error(failed: worker.Failed) -> Exception:
    """That of a process, as if it had come up here."""
    for module in (errors, builtins):
        kind = getattr(module, failed.error, None)
        if isinstance(kind, type) and issubclass(kind, Exception):
            with suppress(TypeError):  # of those that need more than a message
                error = kind(failed.message)
                error.add_note(failed.trace)
                return error
    error = RuntimeError(f"{failed.error}: {failed.message}")
    error.add_note(failed.trace)
    return error
