"""Several processes of torchrun at one command: the first one speaks for all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

from keyss._torchrun import processes, rank
from keyss.core.errors import OtherProcessError, UsageError

COMMANDS = ("fit", "hide")  # that train


def answers() -> bool:
    """Whether this process answers for the command."""
    return rank() == 0


@contextmanager
def one_speaks() -> Iterator[None]:
    """Only the first process writes to the standard streams while the block runs."""
    if answers():
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield


def has_to_say(error: BaseException) -> bool:
    """Whether `error` is to be told by this process: others tell what only they can know.

    What is wrong with arguments all find, signals come to all, and who has ended tells why by itself.
    """
    return answers() or not isinstance(error, UsageError | OtherProcessError | KeyboardInterrupt)


def name() -> str:
    """Of a process that is not the first, before what it says."""
    return "" if answers() else f"process {rank() + 1} of {processes()}: "


def check_command(command: str, *, trains: bool | None = None) -> None:
    """Raise UsageError for a command that several processes would only do several times."""
    trains = command.startswith("-") or command in COMMANDS if trains is None else trains
    if processes() > 1 and not trains:
        raise UsageError(f"torchrun is for `keyss fit` and `keyss hide`: start `keyss {command}` without it")
