"""The loop of every training run: progress, checkpoints, signals, resume."""

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

from keyss import _threads
from keyss._interrupts import ENDING
from keyss.core.errors import InputError, Interrupted, KeyssWarning
from keyss.fitting.checkpoint import State, load_checkpoint, save_checkpoint
from keyss.fitting.config import FitConfig
from keyss.fitting.sampling import own_randomness
from keyss.progress import Reporter


class TrainingRun(Protocol):
    """A training run. Its future depends only on the result of `state`."""

    iterations: int
    iteration: int  # steps done

    def step(self) -> None:
        """Take one optimisation step, which increases `iteration`."""

    def evaluate(self) -> dict[str, float]:
        """Quality on held-out views, by name."""

    def state(self) -> tuple[State, dict[str, Any]]:
        """Tensors (not copied) and JSON-able numbers."""

    def load(self, tensors: State, meta: dict[str, Any]) -> None: ...

    def __len__(self) -> int:
        """Number of Gaussians."""


_SPINNING = (
    "torch was imported before keyss, and its idle threads keep cores busy: training on a CPU takes up to "
    "1.5 times as long; import keyss first, or set the environment variable OMP_WAIT_POLICY to passive"
)


def train(
    run: TrainingRun,
    title: str,
    config: FitConfig,
    *,
    fingerprint: dict[str, Any],
    checkpoint: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> None:
    """Run all remaining iterations, with the seed and the intervals of `config`.

    With `checkpoint`, the state is saved there every `checkpoint_seconds`, on Ctrl-C, SIGTERM and SIGHUP
    (raises Interrupted), and at the end; with `resume`, training continues from it if the file exists.
    Raises InputError for a checkpoint with another `fingerprint`: JSON-able settings and digests of inputs.
    On a CPU, the same seed gives the same model, interrupted or not. The global random state, from which
    gsplat's densification samples, is seeded, saved in the checkpoint, and restored for the caller.
    """
    reporter = reporter or Reporter()
    if _threads.spinning and torch.get_num_threads() > 1:
        warnings.warn(_SPINNING, KeyssWarning, stacklevel=2)

    def save() -> None:
        if checkpoint is not None:
            tensors, meta = run.state()
            tensors |= {"rng": torch.get_rng_state()}
            save_checkpoint(checkpoint, tensors, meta | {"fingerprint": fingerprint})

    with defer_signals(saves=checkpoint is not None) as interrupted, own_randomness(config.known_seed):
        if checkpoint is not None and resume and checkpoint.exists():
            _resume(run, checkpoint, fingerprint)
        saved = time.monotonic()
        numbers: dict[str, float] = {}
        reporter.start(title, run.iterations, run.iteration)
        try:
            while run.iteration < run.iterations:
                run.step()
                if config.evaluate_every and run.iteration % config.evaluate_every == 0:
                    numbers = run.evaluate()
                reporter.update(run.iteration, len(run), numbers)
                if signum := interrupted():
                    save()
                    raise Interrupted(checkpoint, run.iteration, signum)
                if time.monotonic() - saved > config.checkpoint_seconds:
                    save()
                    saved = time.monotonic()
            save()
        finally:
            reporter.finish()


def _resume(run: TrainingRun, checkpoint: Path, fingerprint: dict[str, Any]) -> None:
    """Load a checkpoint. Raises InputError for one of another run or another version."""
    tensors, meta = load_checkpoint(checkpoint)
    if meta.get("fingerprint") != fingerprint:
        remedy = "give the same ones, or start anew with `overwrite=True`"
        raise InputError(f"{checkpoint}: belongs to a run with other settings or inputs; {remedy}")
    try:
        torch.set_rng_state(tensors.pop("rng"))
        run.load(tensors, meta)
    except KeyError as error:
        raise InputError(f"{checkpoint}: not a checkpoint of this version (no {error})") from error


@contextmanager
def defer_signals(*, saves: bool) -> Iterator[Callable[[], signal.Signals | None]]:
    """Turn signals into a flag to check between steps; a second signal acts at once.

    SIGTERM and SIGHUP are deferred only if the caller `saves` its state. Ignored signals stay ignored, as
    under `nohup`.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    seen: signal.Signals | None = None

    def note(signum: int, frame: Any) -> None:
        nonlocal seen
        if seen is None:
            seen = signal.Signals(signum)
            return
        restore()
        signal.raise_signal(signum)

    def restore() -> None:
        for signum, handler in previous.items():
            signal.signal(signum, handler)

    handlers = {signum: signal.getsignal(signum) for signum in (ENDING if saves else (signal.SIGINT,))}
    # None: a handler not installed from Python, which could not be restored.
    previous = {signum: old for signum, old in handlers.items() if old not in (signal.SIG_IGN, None)}
    try:
        for signum in previous:
            signal.signal(signum, note)
        yield lambda: seen
    finally:
        restore()
    if seen is not None:  # arrived after the last check
        signal.raise_signal(seen)
