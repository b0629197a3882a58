"""Errors that a person can cause. Each carries an exit status of its own for the command line.

A message says what was expected, what came, and what to do. It names arguments as Python does, between
backticks: `overwrite=True`, `method="learned"`, `sh_degree`. The command line prints it in one line, with its
own flags instead, and never shows a traceback for these.
"""

from __future__ import annotations

import signal
from pathlib import Path


class KeyssError(Exception):
    """Base of every error that a person can cause."""

    exit_status = 1


class UsageError(KeyssError):
    """Arguments that contradict each other or are out of range."""

    exit_status = 2


class WrongKeyError(KeyssError):
    """The key opens nothing here."""

    exit_status = 3


class InputError(KeyssError):
    """A file or folder that cannot be read as what it should be."""

    exit_status = 4


class OutputError(KeyssError):
    """A result that cannot be written (it exists, the disk is full, no permission)."""

    exit_status = 5


class QualityError(KeyssError):
    """What was made is not good enough to be given out."""

    exit_status = 7


class BackendError(KeyssError):
    """A backend or an optional dependency that is not there."""

    exit_status = 6


class OtherProcessError(BackendError):
    """Of several processes that work on one run, another one has ended: that one knows why."""


class KeyssWarning(UserWarning):
    """A result came out, but there is something to know about it; worded as messages of errors are."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or another signal during long work, after `iteration` steps of a training.

    What is done was saved to `checkpoint` (None: there was none to write).
    """

    def __init__(
        self, checkpoint: Path | None, iteration: int | None, signum: signal.Signals = signal.SIGINT
    ) -> None:
        super().__init__(signum)
        self.checkpoint = checkpoint
        self.iteration = iteration


def signal_of(interrupt: KeyboardInterrupt) -> signal.Signals:
    """Which signal an interrupt came from: Ctrl-C unless it says otherwise."""
    return signal.Signals(interrupt.args[0]) if interrupt.args else signal.SIGINT
