"""Commands in several processes, as torchrun starts them: the first process prints for all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

from keyss._torchrun import processes, rank
from keyss.core.errors import OtherProcessError, UsageError

COMMANDS = ("fit", "hide")  # that train


def answers() -> bool:
    """True in the first process, or the only one."""
    return rank() == 0


@contextmanager
def only_first_prints() -> Iterator[None]:
    """Silences the standard streams of all processes but the first."""
    if answers():
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield


def prints(error: BaseException) -> bool:
    """True if this process prints `error`: only the first prints errors that all of them raise."""
    return answers() or not isinstance(error, UsageError | OtherProcessError | KeyboardInterrupt)


def prefix() -> str:
    """The name of this process in messages, if it is not the first."""
    return "" if answers() else f"process {rank() + 1} of {processes()}: "


def check_command(command: str, *, trains: bool | None = None) -> None:
    """Raise UsageError for a command that does not train, in several processes."""
    trains = command.startswith("-") or command in COMMANDS if trains is None else trains
    if processes() > 1 and not trains:
        raise UsageError(f"torchrun is for `keyss fit` and `keyss hide`: start `keyss {command}` without it")
