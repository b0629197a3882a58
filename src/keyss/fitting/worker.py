"""The process that fits one plain model for another process: `python -m keyss.fitting.worker`.

Its standard input says what to fit, and its standard output tells how far it is and ends with the model, both
as messages of tensors and JSON. It writes nothing to the disk but the checkpoint, and ends when whoever
started it does.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass, fields
from pathlib import Path
from types import FrameType
from typing import IO, get_args

import msgspec
import torch

from keyss.core.errors import Interrupted, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View
from keyss.fitting.checkpoint import State, pack_state, unpack_state
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import ENDING
from keyss.fitting.plain import fit_scene

MODULE = "keyss.fitting.worker"
_EVERY = 0.1  # seconds between two reports in which nothing is new but the number of the step
_SIZE_BYTES = 8


@dataclass(frozen=True)
class Order:
    """What to fit, as `fit_scene` has it.

    The message has the scene's points, colors and background, and its views follow.
    """

    train: int  # views
    test: int
    config: FitConfig
    title: str
    checkpoint: str | None
    resume: bool
    loss_every: int  # of the reporter


@dataclass(frozen=True)
class OneView:
    """A view of the scene, in the message's tensors."""


@dataclass(frozen=True)
class Threads:
    """So many may be used from now on; the model does not depend on it."""

    count: int


@dataclass(frozen=True)
class Progress:
    """See `Reporter.update`."""

    iteration: int
    gaussians: int
    numbers: dict[str, float]


@dataclass(frozen=True)
class Fitted:
    """The end: the message has the model's tensors."""

    seconds: float


@dataclass(frozen=True)
class Stopped:
    """The end after a signal: the checkpoint is there, if there was to be one."""


@dataclass(frozen=True)
class Failed:
    """The end with an error, of a class of `keyss.core.errors`, or MemoryError."""

    error: str
    message: str


Told = Order | OneView | Threads | Progress | Fitted | Stopped | Failed
_KINDS: dict[str, type[Told]] = {kind.__name__: kind for kind in get_args(Told)}


def send(file: IO[bytes], told: Told, tensors: State | None = None) -> None:
    """Write a message. Raises OSError where nobody reads."""
    meta = {"kind": type(told).__name__, "told": msgspec.to_builtins(told)}
    data = pack_state(tensors or {}, meta)
    file.write(len(data).to_bytes(_SIZE_BYTES, "little"))
    file.write(data)
    file.flush()


def receive(file: IO[bytes]) -> tuple[Told, State] | None:
    """The next message; None at the end, also in the middle of one."""
    size = file.read(_SIZE_BYTES)
    if len(size) < _SIZE_BYTES:
        return None
    data = file.read(length := int.from_bytes(size, "little"))
    if len(data) < length:
        return None
    tensors, meta = unpack_state(data)
    return msgspec.convert(meta["told"], _KINDS[meta["kind"]]), tensors


def send_order(file: IO[bytes], order: Order, scene: Scene) -> None:
    """Say what to fit to which scene, of which nothing is held twice. Raises OSError where nobody reads."""
    send(file, order, {"points": scene.points, "colors": scene.colors, "background": scene.background})
    for view in scene.views:
        tensors = {"viewmat": view.camera.viewmat, "K": view.camera.K, "image": view.image}
        send(file, OneView(), tensors if view.drawn is None else tensors | {"drawn": view.drawn})


def receive_order(file: IO[bytes]) -> tuple[Order, Scene] | None:
    """What `send_order` said; neither the scene nor its views have names. None where it ends too early."""
    if (found := receive(file)) is None:
        return None
    order, rest = found
    assert isinstance(order, Order)
    views: list[View] = []
    while len(views) < order.train + order.test:
        if (found := receive(file)) is None:
            return None
        tensors = found[1]
        height, width = tensors["image"].shape[:2]
        camera = Camera(tensors["viewmat"], tensors["K"], width, height)
        views.append(View(camera, tensors["image"], tensors.get("drawn")))
    return order, Scene("", tuple(views[: order.train]), tuple(views[order.train :]), **rest)


class _Teller:
    """A `Reporter` that writes messages, and does between steps what came in the meantime."""

    def __init__(self, file: IO[bytes], loss_every: int) -> None:
        self.file, self.loss_every = file, loss_every
        self.told = 0.0
        self.numbers: dict[str, float] = {}
        self.signalled = False
        self.threads: int | None = None  # to be used from now on

    def on_signal(self, signum: int, frame: FrameType | None) -> None:
        """Of signals that come before the training has a handler of its own, or after it."""
        self.signalled = True

    def listen(self, file: IO[bytes]) -> None:
        """On a thread of its own: what whoever started this process has to say, until it ends."""
        while (found := receive(file)) is not None:
            if isinstance(found[0], Threads):
                self.threads = found[0].count
        os._exit(128 + signal.SIGHUP)  # nothing is lost, for a checkpoint appears when it is whole

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.iterations = iterations

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.signalled:
            self.signalled = False
            signal.raise_signal(signal.SIGINT)
        if self.threads is not None:  # torch counts them for each thread that computes
            torch.set_num_threads(self.threads)
            self.threads = None
        if numbers == self.numbers and iteration < self.iterations and time.monotonic() - self.told < _EVERY:
            return
        self.told, self.numbers = time.monotonic(), dict(numbers)
        send(self.file, Progress(iteration, gaussians, self.numbers))

    def note(self, line: str) -> None: ...

    def finish(self) -> None: ...


def main() -> int:
    """Fit what the standard input says; the exit status."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is not a message
    if (found := receive_order(sys.stdin.buffer)) is None:  # whoever asked has gone
        return 1
    order, scene = found
    teller = _Teller(answers, order.loss_every)
    threading.Thread(target=teller.listen, args=(sys.stdin.buffer,), daemon=True).start()
    for signum in ENDING:
        signal.signal(signum, teller.on_signal)
    try:
        send(answers, *_fit(order, scene, teller))
    except BrokenPipeError:
        return 1
    return 0


def _fit(order: Order, scene: Scene, teller: _Teller) -> tuple[Told, State]:
    try:
        result = fit_scene(
            scene,
            order.config,
            title=order.title,
            checkpoint=Path(order.checkpoint) if order.checkpoint else None,
            resume=order.resume,
            reporter=teller,
        )
    except Interrupted:
        return Stopped(), {}
    except (KeyssError, MemoryError) as error:
        return Failed(type(error).__name__, str(error)), {}
    except RuntimeError as error:
        if "can't allocate memory" not in str(error):  # torch has no class of its own for it
            raise
        return Failed(MemoryError.__name__, str(error)), {}
    model = result.gaussians
    return Fitted(result.seconds), {each.name: getattr(model, each.name) for each in fields(Gaussians)}


if __name__ == "__main__":
    status = main()
    atexit._run_exitfuncs()
    os._exit(status)  # to clean up would take the interpreter another second
