"""The loop around every training run: progress, checkpoints, Ctrl-C and other signals, resume.

And of several processes, see `keyss.fitting.ranks`.
"""

from __future__ import annotations

import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from keyss import _threads
from keyss.core.errors import InputError, Interrupted as Interrupted, KeyssWarning, OtherProcessError
from keyss.fitting.checkpoint import State, load_checkpoint, pack_state, save_checkpoint, unpack_state
from keyss.fitting.ranks import here
from keyss.fitting.reporting import Modelled, ModelReporter, Reporter, SilentReporter
from keyss.fitting.sampling import own_randomness

ENDING = tuple(
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__
)

# Whether a second signal changes nothing: in a process that another one ends where that must be at once.
patient = False

REMEDY = "continue with the same command and `resume=True`"


class TrainingRun(Protocol):
    """A training run: everything that `state` returns decides its future completely."""

    iterations: int
    iteration: int  # steps done

    @property
    def loss(self) -> float | Tensor:
        """That of the last step."""

    def step(self) -> None:
        """One optimisation step; increases `iteration`.

        What waits for other processes comes before parameters change: where one has ended, only the order
        of views and `iteration` are ahead.
        """

    def evaluate(self) -> dict[str, float]:
        """The numbers a person watches, on held-out views."""

    def state(self) -> tuple[State, dict[str, Any]]:
        """Its tensors are those of the run, not copies, but for the order of views."""

    def load(self, tensors: State, meta: dict[str, Any]) -> None: ...

    def __len__(self) -> int:
        """Number of Gaussians."""


_SPINNING = (
    "torch was imported before keyss, and its idle threads keep processors from others: on a CPU, training "
    "takes up to 1.5 times as long; import keyss first, or set the environment variable OMP_WAIT_POLICY to "
    "passive"
)


def train(
    run: TrainingRun,
    title: str,
    *,
    fingerprint: dict[str, Any],
    seed: int,
    checkpoint: Path | None = None,
    resume: bool = False,
    checkpoint_seconds: float = 180.0,
    evaluate_every: int = 500,
    reporter: Reporter | None = None,
) -> float:
    """Take `run` to its last iteration; returns the seconds spent, those before a resume included.

    With `checkpoint`, the state is saved there every `checkpoint_seconds`, on Ctrl-C, SIGTERM and SIGHUP
    (raises Interrupted) and at the end; with `resume`, it continues from there if the file exists.
    `fingerprint` (JSON-able) is what must be the same for a resumed run to mean the same; a checkpoint of
    another one raises InputError. The same seed gives the same run on a CPU, interrupted or not: the global
    random state, which gsplat's densification draws from, is seeded here, kept in the checkpoint, and given
    back to the caller.

    Of several processes the first has the `checkpoint`, the `reporter` and the numbers; the others begin with
    its state. A signal to one of them interrupts all. Where one ends, the first saves, and all raise
    OtherProcessError.
    """
    ranks = here()
    if not ranks.first:
        checkpoint, reporter, evaluate_every = None, None, 0
    reporter = reporter or SilentReporter()
    if _threads.spinning and torch.get_num_threads() > 1:
        warnings.warn(_SPINNING, KeyssWarning, stacklevel=2)
    spent = 0.0
    saves = checkpoint is not None or ranks.count > 1
    with deferred(saves=saves) as interrupted, own_randomness(seed):
        if checkpoint is not None and resume and checkpoint.exists():
            tensors, meta = load_checkpoint(checkpoint)
            if meta.get("fingerprint") != fingerprint:
                remedy = "give the same ones, or start anew with `overwrite=True`"
                raise InputError(f"{checkpoint}: belongs to a run with other settings or inputs; {remedy}")
            try:
                torch.set_rng_state(tensors.pop("rng"))
                run.load(tensors, meta)
                spent = float(meta["seconds"])
            except KeyError as error:
                raise InputError(f"{checkpoint}: not a checkpoint of this version (no {error})") from error
        if ranks.count > 1:
            tensors, meta = run.state()
            given = ranks.from_first(pack_state(tensors | {"rng": torch.get_rng_state()}, meta))
            if not ranks.first:
                tensors, meta = unpack_state(given)
                torch.set_rng_state(tensors.pop("rng"))
                run.load(tensors, meta)
        started = saved = time.monotonic()
        numbers: dict[str, float] = {}
        look = reporter.look if isinstance(reporter, ModelReporter) else None
        model = run.gaussians if isinstance(run, Modelled) else None
        reporter.start(title, run.iterations, run.iteration)

        def save(state: tuple[State, dict[str, Any]] | None = None) -> None:
            if checkpoint is None:
                return
            tensors, meta = state or run.state()
            tensors["rng"] = torch.get_rng_state()
            seconds = spent + time.monotonic() - started
            save_checkpoint(checkpoint, tensors, {**meta, "fingerprint": fingerprint, "seconds": seconds})

        before = None  # a step that needs other processes
        try:
            while run.iteration < run.iterations:
                before = run.state() if ranks.count > 1 else None
                run.step()
                before = None
                if evaluate_every and run.iteration % evaluate_every == 0:
                    numbers = run.evaluate()
                told = numbers
                if reporter.loss_every and run.iteration % reporter.loss_every == 0:
                    told = numbers | {"loss": float(run.loss)}
                reporter.update(run.iteration, len(run), told)
                if look and model:
                    look(model)
                if signum := ranks.agree(interrupted() or 0, len(run)):
                    save()
                    raise Interrupted(checkpoint, run.iteration, signal.Signals(signum))
                if time.monotonic() - saved > checkpoint_seconds:
                    save()
                    saved = time.monotonic()
            save()
        except OtherProcessError as error:
            save(before)
            saved_to = "nothing was saved" if checkpoint is None else REMEDY
            raise OtherProcessError(f"{error}; {saved_to}") from error
        finally:
            reporter.finish()
        return spent + time.monotonic() - started


@contextmanager
def deferred(*, saves: bool) -> Iterator[Callable[[], signal.Signals | None]]:
    """Turn signals into a flag that is looked at between steps; a second one acts at once.

    Those that end a process are left to do so unless something `saves` then. Signals that the process ignores
    stay ignored, as those of a program that `nohup` started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    seen: signal.Signals | None = None

    def note(signum: int, frame: Any) -> None:
        nonlocal seen
        if seen is None or patient:
            seen = seen or signal.Signals(signum)
            return
        restore()
        signal.raise_signal(signum)

    def restore() -> None:
        for signum, handler in previous.items():
            signal.signal(signum, handler)

    handlers = {signum: signal.getsignal(signum) for signum in (ENDING if saves else (signal.SIGINT,))}
    # None: a handler that is not Python's, which could not be put back.
    previous = {signum: old for signum, old in handlers.items() if old not in (signal.SIG_IGN, None)}
    try:
        for signum in previous:
            signal.signal(signum, note)
        yield lambda: seen
    finally:
        restore()
    if seen is not None:  # nobody looked any more
        signal.raise_signal(seen)
