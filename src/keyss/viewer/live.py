"""A local page that shows a training while it runs.

The model is copied between two steps while a page polls, at most every few seconds and for at most a fiftieth
of the time; the server's thread encodes the copy.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from io import BytesIO
from types import TracebackType
from typing import Any, BinaryIO, Literal, Self

from keyss.core.errors import KeyssError
from keyss.core.gaussians import Gaussians
from keyss.files.models import model_bytes
from keyss.progress import Reporter
from keyss.viewer.look import Look
from keyss.viewer.page import served_page
from keyss.viewer.serving import PageServer

Side = Literal["published", "secret"]
EVERY = 3.0  # minimum seconds between two copies
_COST = 50  # a copy is followed by a pause of this many times its duration
_WATCHED = 15.0  # seconds after a request for which the page counts as open
_LAST = 5.0  # maximum seconds for which the result is served
_STATE = "live"
# `numbers` are in decibels, by name.
_NO_PROGRESS: dict[str, Any] = {"title": "", "iteration": 0, "iterations": 0, "gaussians": 0, "numbers": {}}


@dataclass
class _Copy:
    """A copy of a model, and its file once requested."""

    version: int
    model: Gaussians
    ply: bytes | None = None


class LiveTraining:
    """A context that serves the page of a training on a thread of its own."""

    def __init__(self, look: Look | None = None, timer: Callable[[], float] = time.monotonic) -> None:
        """Raises OutputError."""
        contents = {_STATE: ("application/json", self._state)}
        for side in ("published", "secret"):
            contents[f"{_STATE}/{side}.ply"] = ("application/octet-stream", self._opener(side))
        self._server = PageServer(served_page("keyss-live", _STATE, look or {}), contents)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._timer = timer
        self._progress = _NO_PROGRESS
        self._copies: dict[str, _Copy] = {}
        self._requested = self._copied = -float("inf")
        self._pause = EVERY
        self._version = 0

    @property
    def address(self) -> str:
        """The URL of the page, which cannot be guessed."""
        return self._server.address

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The page polls every 2 s: let it fetch the result.
        deadline = time.monotonic() + _LAST
        while kind is None and time.monotonic() < deadline and self._is_unseen():
            time.sleep(0.1)
        self._server.close()
        self._thread.join()

    def _is_unseen(self) -> bool:
        """True if a page is open that has not fetched the newest copies."""
        watched = self._timer() - self._requested < _WATCHED
        return watched and any(copy.ply is None for copy in self._copies.values())

    def reporter(self, reporter: Reporter) -> LiveReporter:
        """A reporter that updates the page and passes everything on to `reporter`."""
        return LiveReporter(self, reporter, "published")

    def progress(self, **shown: Any) -> None:
        """Set the progress on the page: any fields of `_NO_PROGRESS`."""
        self._progress = _NO_PROGRESS | shown

    def look(self, side: Side, model: Callable[[], Gaussians]) -> None:
        """Copy the model if a page is open and a copy is due, and always after the last step."""
        now, is_last = self._timer(), self._progress["iteration"] >= self._progress["iterations"]
        is_due = now - self._requested < _WATCHED and now - self._copied >= self._pause
        if not (is_due or is_last):
            return
        current = model().detach().to("cpu")
        copied = Gaussians(*(getattr(current, each.name).clone() for each in fields(Gaussians)))
        self._version += 1
        self._copies[side] = _Copy(self._version, copied)
        self._copied = self._timer()
        self._pause = max(EVERY, _COST * (self._copied - now))

    def _state(self) -> BinaryIO:
        self._requested = self._timer()
        copies = {side: self._copies.get(side) for side in ("published", "secret")}
        versions = {side: copy.version if copy else 0 for side, copy in copies.items()}
        return BytesIO(json.dumps({**self._progress, "versions": versions}).encode())

    def _opener(self, side: str) -> Callable[[], BinaryIO]:
        def open_copy() -> BinaryIO:
            copy = self._copies.get(side)
            if copy is None:
                raise FileNotFoundError(side)
            if copy.ply is None:
                try:
                    copy.ply = model_bytes("model.ply", copy.model)
                except KeyssError as error:  # a diverged training
                    raise OSError(str(error)) from error
            return BytesIO(copy.ply)

        return open_copy


class LiveReporter(Reporter):
    """Passes everything on to `reporter`, and shows progress and model on the page."""

    def __init__(self, training: LiveTraining, reporter: Reporter, side: Side) -> None:
        self._training, self._reporter, self._side = training, reporter, side
        self._known: dict[str, Any] = {}

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self._reporter.start(title, iterations, iteration)
        self._known = {"title": title, "iterations": iterations}
        self._training.progress(**self._known, iteration=iteration)

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self._reporter.update(iteration, gaussians, numbers)
        self._training.progress(**self._known, iteration=iteration, gaussians=gaussians, numbers=numbers)

    def look(self, model: Callable[[], Gaussians]) -> None:
        self._training.look(self._side, model)

    def of_secret(self) -> Reporter:
        return LiveReporter(self._training, self._reporter, "secret")

    def note(self, line: str) -> None:
        self._reporter.note(line)

    def finish(self) -> None:
        self._reporter.finish()
