"""Errors that users can cause, each with its exit status.

A message says what was expected, what was found, and what to do. It names arguments as in Python, between
backticks: `overwrite=True`, `method="carry"`, `sh_degree`. The command line replaces these with flags, and
prints one line without a traceback.
"""

from __future__ import annotations

import signal
from collections.abc import Collection
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

OPENS_NOTHING = (
    "this key opens nothing here: it may be another key or misspelt; nothing may be hidden; or the model has "
    "changed since it was published (converted or quantised, moved, scaled, pruned, edited, trained on or "
    "hidden in again): try the file as it was published"
)
_PACKAGES = {"ot": "pot", "sklearn": "scikit-learn", "yaml": "pyyaml"}  # module: package, if the names differ
MAX_LENGTH = 100  # characters of a misspelt name that count


class KeyssError(Exception):
    """Base of all errors that users can cause."""

    exit_status = 1


class UsageError(KeyssError):
    """Arguments that are out of range or contradict each other."""

    exit_status = 2


class WrongKeyError(KeyssError):
    """The key opens nothing; the message is the same whatever the reason."""

    exit_status = 3

    def __init__(self, message: str = OPENS_NOTHING) -> None:
        super().__init__(message)


class InputError(KeyssError):
    """A file or folder that is missing, unreadable or of another kind."""

    exit_status = 4


class OutputError(KeyssError):
    """A result that cannot be written: it exists, the disk is full, permission is denied."""

    exit_status = 5


class QualityError(KeyssError):
    """A result that fails its quality check."""

    exit_status = 7


class BackendError(KeyssError):
    """A missing backend or optional package."""

    exit_status = 6


class KeyssWarning(UserWarning):
    """A problem that does not prevent a result."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or another signal, after `iteration` steps of a training.

    The state was saved to `checkpoint`, unless that is None.
    """

    def __init__(
        self, checkpoint: Path | None, iteration: int | None, signum: signal.Signals = signal.SIGINT
    ) -> None:
        super().__init__(signum)
        self.checkpoint = checkpoint
        self.iteration = iteration


def signal_of(interrupt: KeyboardInterrupt) -> signal.Signals:
    """The signal of an interrupt, by default that of Ctrl-C."""
    return signal.Signals(interrupt.args[0]) if interrupt.args else signal.SIGINT


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an optional package; `purpose` is for example "write films".

    Raises BackendError, which names the package and the extra, if it cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = _PACKAGES.get(module.partition(".")[0], module)
        raise BackendError(
            f"to {purpose}, install {package}: pip install 'keyss[{extra}]' ({error})"
        ) from error


def of_other_version(found: int, known: int) -> str:
    """The message about a secret of another version than this program reads."""
    cure = "update keyss" if found > known else "open it with the keyss that wrote it, and hide it again"
    return f"secret of version {found}; this program reads version {known}: {cure}"


def not_whole(kind: str, found: str) -> InputError:
    """The error of a file that lacks a part of what its format asks for."""
    return InputError(f"not a whole {kind}: {found}; download or copy it again")


def damaged(kind: str, found: str) -> InputError:
    """The error of a file whose content contradicts its format."""
    return InputError(f"damaged {kind}: {found}; download or export it again")


def nearest(word: str, known: Collection[str]) -> str | None:
    """The most similar of the `known` names, None if none is similar."""
    matches = get_close_matches(word[:MAX_LENGTH], sorted(known), n=1, cutoff=0.7)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Collection[str]) -> str:
    """The end of a message about a misspelt name: a suggestion, else all `known` names."""
    near = nearest(word, known)
    return f"did you mean {near}?" if near else f"expected one of {', '.join(sorted(known))}"
