"""Several plain models at the same time, each in a process of its own with its share of the threads.

A training step is many short pieces of work, and the second of two threads waits for half of them: two
trainings of one thread each take less time than one after the other with both (docs/scaling.md). The models
do not depend on the number of threads: they are equal to the bit.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import ModuleType
from typing import cast

import psutil
import torch

from keyss._interrupts import ENDING
from keyss.core.errors import BackendError, Interrupted
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import deferred
from keyss.fitting.plain import fit_scene
from keyss.progress import Reporter

MIN_STEPS = 1000  # shorter trainings are not worth the two seconds that a process takes to start
_SPAWN = multiprocessing.get_context("spawn")
_ENDED = (
    "the process of the {} has ended (exit code {}), as systems end processes when memory runs out; with "
    "OMP_NUM_THREADS=1 in the environment, fits run one after the other and need less; `resume=True` "
    "continues from the last checkpoint"
)


@dataclass(frozen=True, eq=False)
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

    On Ctrl-C and on errors, running fits save their checkpoints. Raises BackendError if a process is killed.
    """
    size, models = at_once(fits, torch.device(device)), list[Gaussians]()
    while rest := fits[len(models) : len(models) + size]:
        if len(rest) > 1:
            models += _side_by_side(rest, resume)
        else:
            models.append(fit_scene(**vars(rest[0]), device=device, resume=resume).gaussians)
    return models


def at_once(fits: Sequence[Fit], device: torch.device) -> int:
    """The number of fits that run at the same time: as threads and memory allow.

    It is 1 on GPUs, for fits of fewer than MIN_STEPS, if a reporter cannot follow several, and where no
    process can be started: in those of `multiprocessing`, and in frozen apps.
    """
    size = min(len(fits), torch.get_num_threads())
    if device.type != "cpu" or multiprocessing.parent_process() or hasattr(sys, "frozen"):
        return 1
    for fit in fits:
        if fit.config.iterations < MIN_STEPS or (fit.reporter and not fit.reporter.several):
            return 1
        numbers = fit.config.max_gaussians * (11 + 3 * (fit.config.sh_degree + 1) ** 2)
        photos = sum(view.image.nbytes for view in fit.scene.train)
        needed = (500 << 20) + 13 * photos + 64 * numbers  # with the targets of losses, and what Adam needs
        size = min(size, psutil.virtual_memory().available // needed)
    return max(1, size)


def _side_by_side(fits: Sequence[Fit], resume: bool) -> list[Gaussians]:
    running: dict[Connection, tuple[Fit, Reporter, SpawnProcess]] = {}
    models: dict[Connection, Gaussians] = {}
    with deferred(saves=any(fit.checkpoint for fit in fits)) as interrupted:
        try:
            for fit in fits:
                connection, process = _started()
                reporter = fit.reporter or Reporter()
                running[connection] = fit, reporter.beside() if running else reporter, process
            for connection, (fit, reporter, _) in running.items():
                task = replace(fit, reporter=None), resume, torch.get_num_threads() // len(fits)
                _send(connection, (*task, reporter.loss_every))
            while not interrupted() and (left := running.keys() - models.keys()):
                for connection in cast(list[Connection], wait(left, 0.1)):
                    fit, reporter, process = running[connection]
                    try:
                        message = connection.recv()
                    except (EOFError, OSError):
                        process.join()
                        raise BackendError(_ENDED.format(fit.title, process.exitcode)) from None
                    if isinstance(message, Exception):
                        raise message
                    if isinstance(message, Gaussians):
                        models[connection] = message
                    else:
                        getattr(reporter, message[0])(*message[1:])
        finally:
            for connection in running:
                connection.close()  # interrupts trainings, which then save their checkpoints
            for _, reporter, process in running.values():
                process.join()
                reporter.finish()
        if signum := interrupted():
            saved = [fit.checkpoint for fit in fits if fit.checkpoint and fit.checkpoint.exists()]
            raise Interrupted(saved[0] if saved else None, None, signum)
    return [models[connection] for connection in running]


def _started() -> tuple[Connection, SpawnProcess]:
    """A process for one fit, which ignores Ctrl-C (terminals send it to all), and the connection to it."""
    ours, theirs = _SPAWN.Pipe()
    process, script, handler = _SPAWN.Process(target=_work, args=(theirs,)), sys.modules["__main__"], None
    sys.modules["__main__"] = ModuleType("__main__")  # otherwise it would run the script again
    with suppress(ValueError):  # only the main thread handles signals
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with theirs:
            process.start()
    finally:
        sys.modules["__main__"] = script
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
    return ours, process


def _work(connection: Connection) -> None:
    """Receive a fit, and send its progress and its model or error."""
    for signum in ENDING:  # left to the process that has started this one
        signal.signal(signum, signal.SIG_IGN)
    with suppress(EOFError, Interrupted):
        fit, resume, threads, loss_every = connection.recv()
        torch.set_num_threads(threads)
        fit = replace(fit, reporter=_Sender(connection, loss_every))
        try:
            _send(connection, fit_scene(**vars(fit), resume=resume).gaussians)
        except Exception as error:
            error.add_note(traceback.format_exc())
            _send(connection, error)


class _Sender(Reporter):
    """Sends what is reported; interrupts a training when the other end of the connection closes."""

    def __init__(self, connection: Connection, loss_every: int) -> None:
        self.connection, self.loss_every = connection, loss_every

    def start(self, title: str, iterations: int, iteration: int) -> None:
        _send(self.connection, ("start", title, iterations, iteration))

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        _send(self.connection, ("update", iteration, gaussians, numbers))

    def interrupts(self) -> bool:
        return bool(wait([self.connection], 0))


def _send(connection: Connection, message: object) -> None:
    """Send unless the other end is closed; Connection.send would move tensors to shared memory."""
    with suppress(OSError):
        connection.send_bytes(pickle.dumps(message))
