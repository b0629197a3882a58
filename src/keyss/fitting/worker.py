"""The process that fits one plain model for another process: `python -m keyss.fitting.worker DESCRIPTOR`.

Its standard input says what to fit; a pipe, of which it gets the descriptor, takes how far it is and in the
end the model. Both are messages of tensors and JSON. It writes nothing to the disk but the checkpoint, and
ends when whoever started it does.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
import traceback
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, get_args

import msgspec
import torch

from keyss.core.errors import Interrupted, signal_of
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View
from keyss.fitting.checkpoint import State, pack_state, unpack_state
from keyss.fitting.config import FitConfig
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
class Stop:
    """Save the state, and end."""


@dataclass(frozen=True)
class Ready:
    """All that is needed is loaded."""


@dataclass(frozen=True)
class Progress:
    """See `Reporter.update`."""

    iteration: int
    gaussians: int
    numbers: dict[str, float]


@dataclass(frozen=True)
class Fitted:
    """The end: the message has the model's tensors."""


@dataclass(frozen=True)
class Stopped:
    """The end after a signal, or `Stop`: the checkpoint is there, if there was to be one."""

    signum: int


@dataclass(frozen=True)
class Failed:
    """The end with an error."""

    error: str  # its class
    message: str
    trace: str


Message = Order | OneView | Threads | Stop | Ready | Progress | Fitted | Stopped | Failed
_KINDS: dict[str, type[Message]] = {kind.__name__: kind for kind in get_args(Message)}


def send(file: IO[bytes], message: Message, tensors: State | None = None) -> None:
    """Write a message. Raises OSError where nobody reads."""
    meta = {"kind": type(message).__name__, "message": msgspec.to_builtins(message)}
    data = pack_state(tensors or {}, meta)
    file.write(len(data).to_bytes(_SIZE_BYTES, "little"))
    file.write(data)
    file.flush()


def receive(file: IO[bytes]) -> tuple[Message, State] | None:
    """The next message; None at the end, also in the middle of one."""
    size = file.read(_SIZE_BYTES)
    if len(size) < _SIZE_BYTES:
        return None
    data = file.read(length := int.from_bytes(size, "little"))
    if len(data) < length:
        return None
    tensors, meta = unpack_state(data)
    return msgspec.convert(meta["message"], _KINDS[meta["kind"]]), tensors


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


class _Sender:
    """A `Reporter` that sends messages, and does between two steps what was asked for in the meantime."""

    def __init__(self, file: IO[bytes], loss_every: int) -> None:
        self.file, self.loss_every = file, loss_every
        self.sent = 0.0  # when, the last time
        self.numbers: dict[str, float] = {}
        self.threads: int | None = None
        self.stop = False

    def listen(self, file: IO[bytes]) -> None:
        """On a thread of its own: what whoever started this process has to say, until that ends."""
        while (found := receive(file)) is not None:
            match found[0]:
                case Threads(count):
                    self.threads = count
                case Stop():
                    self.stop = True
        os._exit(128 + signal.SIGHUP)  # nothing is lost, for a checkpoint appears when it is whole

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.iterations = iterations

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.stop:
            self.stop = False
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
            signal.raise_signal(signal.SIGINT)  # which the training takes for Ctrl-C
        if self.threads is not None:  # torch counts them for each thread that computes
            torch.set_num_threads(self.threads)
            self.threads = None
        if numbers == self.numbers and iteration < self.iterations and time.monotonic() - self.sent < _EVERY:
            return
        self.sent, self.numbers = time.monotonic(), dict(numbers)
        send(self.file, Progress(iteration, gaussians, self.numbers))

    def note(self, line: str) -> None: ...

    def finish(self) -> None: ...


def main(descriptor: int) -> int:
    """Fit what the standard input says; the exit status."""
    # Ctrl-C in a terminal comes to this process, too, where it is blocked from the start: whoever started it
    # says `Stop`. Then there has to be a handler that a training can take the place of.
    signal.signal(signal.SIGINT, lambda signum, frame: None)
    with os.fdopen(descriptor, "wb") as answers:
        try:
            send(answers, Ready())
            if (found := receive_order(sys.stdin.buffer)) is None:  # whoever asked has gone
                return 1
            order, scene = found
            sender = _Sender(answers, order.loss_every)
            threading.Thread(target=sender.listen, args=(sys.stdin.buffer,), daemon=True).start()
            send(answers, *_fit(order, scene, sender))
        except BrokenPipeError:
            return 1
    return 0


def _fit(order: Order, scene: Scene, sender: _Sender) -> tuple[Message, State]:
    try:
        model = fit_scene(
            scene,
            order.config,
            title=order.title,
            checkpoint=Path(order.checkpoint) if order.checkpoint else None,
            resume=order.resume,
            reporter=sender,
        ).gaussians
    except Interrupted as interrupt:
        return Stopped(signal_of(interrupt)), {}
    except BrokenPipeError:
        raise
    except Exception as error:
        return Failed(type(error).__name__, str(error), traceback.format_exc()), {}
    return Fitted(), {each.name: getattr(model, each.name) for each in fields(Gaussians)}


if __name__ == "__main__":
    status = main(int(sys.argv[1]))
    atexit._run_exitfuncs()
    os._exit(status)  # to clean up would take the interpreter another second
