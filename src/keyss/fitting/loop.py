"""Training runs: what they share, and their loop with progress, checkpoints, signals and resuming."""

from __future__ import annotations

import signal
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from keyss import _threads
from keyss._interrupts import ENDING
from keyss.core.errors import InputError, Interrupted, KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.fitting.checkpoint import State, load_checkpoint, pack_model, save_checkpoint, unpack_model
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered, of_scene
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.schedule import Schedule
from keyss.progress import Reporter

T = TypeVar("T")


@contextmanager
def own_randomness(seed: int) -> Iterator[None]:
    """Seed torch's global generators, on the CPU and the current GPU, and restore them after the block."""
    gpus = [torch.cuda.current_device()] if torch.cuda.is_available() else []
    with torch.random.fork_rng(gpus):
        torch.manual_seed(seed)
        yield


class Shuffle:
    """Samples 0..count-1 without replacement, over and over."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count = count
        self.generator = generator
        self.remaining = torch.empty(0, dtype=torch.int64)

    def sample(self) -> int:
        if len(self.remaining) == 0:
            self.remaining = torch.randperm(self.count, generator=self.generator)
        index = int(self.remaining[-1])
        self.remaining = self.remaining[:-1]
        return index


class TrainingRun(ABC):
    """A training of Gaussians. Its future depends only on the result of `state`."""

    parameters: Parameters
    optimizers: Optimizers
    schedules: list[Schedule]  # for each scene that has parameters of its own
    strategy: CappedStrategy
    density: dict[str, Any]  # the state of `strategy`
    network_optimizers: Sequence[torch.optim.Optimizer] = ()

    def __init__(self, fit: FitConfig, device: torch.device) -> None:
        self.fit, self.device = fit, device
        self.iterations, self.iteration = fit.iterations, 0  # steps in all, steps done
        self.generators = {"generator": torch.Generator().manual_seed(fit.known_seed)}
        self.generator = self.generators["generator"]
        self.shuffles: dict[str, Shuffle] = {}

    @abstractmethod
    def step(self) -> None:
        """Take one optimisation step, which increases `iteration`."""

    @abstractmethod
    def evaluate(self) -> dict[str, float]:
        """Quality on held-out views, by name."""

    @abstractmethod
    def gaussians(self) -> Gaussians:
        """The model, detached."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.parameters["means"])

    def optimise(self, views: Sequence[T], loss_at: Callable[[T], tuple[Tensor, list[Rendered]]]) -> None:
        """Take an optimisation step on the mean loss of `views`; see `CappedStrategy.backward`."""
        self.loss, info = self.strategy.backward(views, loss_at, len(self))
        self.set_rates()
        for optimizer in (*self.optimizers.values(), *self.network_optimizers):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, info)

    def set_rates(self) -> None:
        """Set the learning rates of the step `iteration`."""
        for scene, schedule in enumerate(self.schedules):
            schedule.set(of_scene(self.optimizers, scene), self.iteration)

    def state(self) -> State:
        """Tensors, not copied."""
        state = pack_model(self.parameters, self.optimizers, self.density)
        state |= {name: shuffle.remaining for name, shuffle in self.shuffles.items()}
        return state | {name: generator.get_state() for name, generator in self.generators.items()}

    def load(self, state: State) -> None:
        """Restore the result of `state`; `iteration` is the caller's to set."""
        unpack_model(state, self.parameters, self.optimizers, self.density)
        for name, shuffle in self.shuffles.items():
            shuffle.remaining = state[name]
        for name, generator in self.generators.items():
            generator.set_state(state[name])


_SPINNING = (
    "torch was imported before keyss, and its idle threads keep cores busy: training on a CPU takes up to "
    "1.5 times as long; import keyss first, or set the environment variable OMP_WAIT_POLICY to passive"
)


def train(
    run: TrainingRun,
    title: str,
    *,
    fingerprint: dict[str, Any],
    checkpoint: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> None:
    """Run all remaining iterations, with the seed and the intervals of the run's `fit`.

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
            tensors = run.state() | {"rng": torch.get_rng_state()}
            save_checkpoint(checkpoint, tensors, {"iteration": run.iteration, "fingerprint": fingerprint})

    with defer_signals(saves=checkpoint is not None) as interrupted, own_randomness(run.fit.known_seed):
        if checkpoint is not None and resume and checkpoint.exists():
            _resume(run, checkpoint, fingerprint)
        saved = time.monotonic()
        numbers: dict[str, float] = {}
        reporter.start(title, run.iterations, run.iteration)
        try:
            while run.iteration < run.iterations:
                run.step()
                if run.fit.evaluate_every and run.iteration % run.fit.evaluate_every == 0:
                    numbers = run.evaluate()
                reporter.update(run.iteration, len(run), numbers)
                reporter.look(run.gaussians)
                if signum := interrupted():
                    save()
                    raise Interrupted(checkpoint, run.iteration, signum)
                if time.monotonic() - saved > run.fit.checkpoint_seconds:
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
        run.load(tensors)
        run.iteration = int(meta["iteration"])
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
