"""Training runs: what they share, and their loop with progress, checkpoints, signals and resuming.

A checkpoint is the state of a run in one safetensors file: tensors and JSON, nothing executable.
"""

from __future__ import annotations

import json
import signal
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from keyss import _threads
from keyss._interrupts import ENDING
from keyss.core.errors import InputError, Interrupted, KeyssWarning
from keyss.files.atomic import write_bytes
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.schedule import Schedule
from keyss.progress import Reporter

State = dict[str, Tensor]
_UNREADABLE = (OSError, KeyError, ValueError, TypeError, safetensors.SafetensorError)


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
    schedule: Schedule
    strategy: CappedStrategy
    density: dict[str, Any]  # the state of `strategy`
    network_optimizer: torch.optim.Optimizer | None = None  # optimiser of `networks`

    def __init__(self, fit: FitConfig, device: torch.device) -> None:
        self.fit, self.device = fit, device
        self.iterations, self.iteration = fit.iterations, 0  # steps in all, steps done
        self.generators = {"generator": torch.Generator().manual_seed(fit.known_seed)}
        self.generator = self.generators["generator"]
        self.shuffles: dict[str, Shuffle] = {}
        self.networks = torch.nn.ModuleList()

    @abstractmethod
    def step(self) -> None:
        """Take one optimisation step, which increases `iteration`."""

    @abstractmethod
    def evaluate(self) -> dict[str, float]:
        """Quality on held-out views, by name."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.parameters["means"])

    def optimise(self, loss: Tensor, renders: Sequence[Rendered]) -> None:
        """Take an optimisation step on a loss; `renders` count for densification."""
        for meta, _, _ in renders:
            meta["means2d"].retain_grad()
        loss.backward()
        self.loss = loss.detach()
        info = self.strategy.statistics(renders, len(self))
        self.set_rates()
        networks = [self.network_optimizer] if self.network_optimizer else []
        for optimizer in (*self.optimizers.values(), *networks):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, info)

    def set_rates(self) -> None:
        """Set the learning rates of the step `iteration`."""
        self.schedule.set(self.optimizers, self.iteration)

    def state(self) -> State:
        """Parameters, their Adam moments, and what else the future depends on; tensors are not copied."""
        state: State = {}
        for name, parameter in self.parameters.items():
            state[name] = parameter.detach()
            for key, value in self.optimizers[name].state[parameter].items():
                state[f"{name}.{key}"] = torch.as_tensor(value)
        density = {key: value for key, value in self.density.items() if isinstance(value, Tensor)}
        state |= {f"density.{key}": value for key, value in density.items()}
        state |= {name: shuffle.remaining for name, shuffle in self.shuffles.items()}
        state |= {f"networks.{name}": value for name, value in self.networks.state_dict().items()}
        if self.network_optimizer:
            for index, moments in self.network_optimizer.state_dict()["state"].items():
                state |= {f"networks_adam.{index}.{name}": value for name, value in moments.items()}
        return state | {name: generator.get_state() for name, generator in self.generators.items()}

    def load(self, state: State) -> None:
        """Restore the result of `state`, but not `iteration`; the number of Gaussians may differ."""
        for name, old in list(self.parameters.items()):
            parameter = torch.nn.Parameter(state[name].to(self.device))
            (group,) = self.optimizers[name].param_groups
            group["params"] = [parameter]
            moments = with_prefix(state, f"{name}.")
            self.optimizers[name].state.pop(old, None)
            if moments:
                self.optimizers[name].state[parameter] = {
                    key: value if key == "step" and not group["fused"] else value.to(self.device)
                    for key, value in moments.items()
                }
            self.parameters[name] = parameter
        density = with_prefix(state, "density.").items()
        self.density |= {key: value.to(self.device) for key, value in density}
        self.networks.load_state_dict(with_prefix(state, "networks."))
        if self.network_optimizer:
            adam = self.network_optimizer.state_dict()
            for name, value in with_prefix(state, "networks_adam.").items():
                index, key = name.split(".")
                adam["state"].setdefault(int(index), {})[key] = value
            self.network_optimizer.load_state_dict(adam)
        for name, shuffle in self.shuffles.items():
            shuffle.remaining = state[name]
        for name, generator in self.generators.items():
            generator.set_state(state[name])


def save_checkpoint(path: Path, tensors: State, meta: Mapping[str, Any]) -> None:
    """Atomically write `tensors` and the JSON-able `meta`; any device can load them. Raises OutputError."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(path, safetensors.torch.save(contiguous, {"meta": json.dumps(meta)}))


def load_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """Tensors (on the CPU) and meta of a checkpoint. Raises InputError when it is missing or damaged."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {})["meta"])
            return {name: file.get_tensor(name) for name in file.keys()}, meta  # noqa: SIM118
    except _UNREADABLE as error:
        raise InputError(f"{path}: not a checkpoint of this version ({error})") from error


def with_prefix(state: State, prefix: str) -> State:
    """The tensors whose names begin with `prefix`, named without it."""
    return {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}


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
