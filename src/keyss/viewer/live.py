"""A training as it is now, on a page of this machine.

While nobody looks, nothing is done. When the page asks, the model is copied between two steps, at most every
few seconds and for at most a fiftieth of the time; a thread of its own makes a file of the copy. The address
has a random part, without which other users of the machine get nothing: a secret may be in training.
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from io import BytesIO
from types import TracebackType
from typing import BinaryIO, Literal, Self

from keyss.core.errors import KeyssError
from keyss.core.gaussians import Gaussians
from keyss.files.models import model_bytes
from keyss.fitting.reporting import Reporter
from keyss.viewer.page import page_live
from keyss.viewer.serving import PageServer

Side = Literal["published", "secret"]
EVERY = 3.0  # seconds between two copies, at least
_COST = 50  # times as long as one takes passes until the next
_WATCHED = 15.0  # seconds after the last question for which somebody is taken to look
_STATE = "live"


@dataclass
class _Copy:
    """A model of some time, and the file that is made of it when it is asked for."""

    version: int
    model: Gaussians
    lock: threading.Lock = field(default_factory=threading.Lock)
    ply: bytes | None = None


@dataclass(frozen=True)
class _Progress:
    title: str = ""
    iteration: int = 0
    iterations: int = 0
    gaussians: int = 0
    numbers: Mapping[str, float] = field(default_factory=dict)


class LiveTraining:
    """The page of a training; a context in which it is served, by a thread of its own."""

    def __init__(self, up: str = "-y", timer: Callable[[], float] = time.monotonic) -> None:
        """Raises OutputError."""
        contents = {_STATE: ("application/json", self._state)}
        for side in ("published", "secret"):
            contents[f"{_STATE}/{side}.ply"] = ("application/octet-stream", self._opens(side))
        folder = f"/{secrets.token_urlsafe(16)}/"
        self._server = PageServer(page_live(_STATE, up), contents, folder=folder)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._timer = timer
        self._progress = _Progress()
        self._copies: dict[str, _Copy] = {}
        self._asked = self._taken = -float("inf")
        self._pause = EVERY
        self._version = 0

    @property
    def address(self) -> str:
        """Where the page is; nobody finds it without being told."""
        return self._server.address

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.close()
        self._thread.join()

    def reporter(self, told: Reporter) -> LiveReporter:
        """What a training reports to, so that the page follows it; all of it is passed on to `told`."""
        return LiveReporter(self, told, "published")

    def progress(self, progress: _Progress) -> None:
        self._progress = progress

    def look(self, side: Side, model: Callable[[], Gaussians]) -> None:
        """Copy the model if somebody looks and it is time; always after a training's last step."""
        now, last = self._timer(), self._progress.iteration >= self._progress.iterations
        looked_at = now - self._asked < _WATCHED and now - self._taken >= self._pause
        if not (looked_at or last):
            return
        taken = model().detach().to("cpu")
        copied = Gaussians(*(getattr(taken, each.name).clone() for each in fields(Gaussians)))
        self._version += 1
        self._copies[side] = _Copy(self._version, copied)
        self._taken = self._timer()
        self._pause = max(EVERY, _COST * (self._taken - now))

    def _state(self) -> BinaryIO:
        self._asked = self._timer()
        versions = {side: self._copies[side].version if side in self._copies else 0 for side in _SIDES}
        return BytesIO(json.dumps({**vars(self._progress), "versions": versions}).encode())

    def _opens(self, side: str) -> Callable[[], BinaryIO]:
        def opened() -> BinaryIO:
            copy = self._copies.get(side)
            if copy is None:
                raise FileNotFoundError(side)
            with copy.lock:
                if copy.ply is None:
                    try:
                        copy.ply = model_bytes("model.ply", copy.model)
                    except KeyssError as error:  # a training that went wrong
                        raise OSError(str(error)) from error
            return BytesIO(copy.ply)

        return opened


_SIDES: tuple[Side, Side] = ("published", "secret")


class LiveReporter:
    """Passes all on to `told`, and shows the page how far the training is and what it came to."""

    def __init__(self, training: LiveTraining, told: Reporter, side: Side) -> None:
        self.training, self.told, self.side = training, told, side
        self.title, self.iterations = "", 0

    @property
    def loss_every(self) -> int:
        return self.told.loss_every

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.told.start(title, iterations, iteration)
        self.title, self.iterations = title, iterations
        self.training.progress(_Progress(title, iteration, iterations))

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.told.update(iteration, gaussians, numbers)
        decibels = {name: value for name, value in numbers.items() if name != "loss"}
        self.training.progress(_Progress(self.title, iteration, self.iterations, gaussians, decibels))

    def look(self, model: Callable[[], Gaussians]) -> None:
        self.training.look(self.side, model)

    def of_secret(self) -> Reporter:
        return LiveReporter(self.training, self.told, "secret")

    def note(self, line: str) -> None:
        self.told.note(line)

    def finish(self) -> None:
        self.told.finish()
