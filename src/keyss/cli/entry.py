"""The entry point: runs a command, and turns errors into one line and an exit status.

A command's module is imported when it runs, and imports heavy packages inside the command, which keeps
`keyss --help` fast.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from itertools import pairwise
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from keyss import __version__
from keyss.core.errors import (
    BackendError,
    Interrupted,
    KeyssError,
    KeyssWarning,
    OutputError,
    UsageError,
    did_you_mean,
    nearest,
    signal_of,
)

BROKEN_PIPE = 141  # 128 + SIGPIPE, as a shell counts
OUT_OF_MEMORY = 8
INTERNAL_ERROR = 70  # EX_SOFTWARE
_LEVELS = {"-q": -1, "--quiet": -1, "-v": 1, "--verbose": 1}
_KEY_OPTIONS = ("-k", "-p", "--key", "--keys", "--password", "--passphrase")  # options that people may expect
# Arguments whose options have another name.
_RENAMED = {"key": "key_file", "keys": "key_file", "secrets": "secret", "model": "secret_model"}
# The commands, in the groups of `keyss --help`, and the module of each.
GROUPS = {
    "make": {
        "demo": "cli.make",
        "fit": "cli.make",
        "hide": "cli.hide_command",
        "keygen": "cli.make",
        "convert": "cli.make",
    },
    "open": {"reveal": "cli.open_and_show", "verify": "cli.open_and_show"},
    "look": {"view": "cli.open_and_show", "render": "cli.open_and_show", "info": "cli.open_and_show"},
    "measure": {"evaluate": "cli.open_and_show", "audit": "lab.lab_commands"},
    "many": dict.fromkeys(("compare", "reproduce", "sweep"), "lab.lab_commands"),
    "check": {"doctor": "cli.doctor"},
}
MODULES = {name: module for group in GROUPS.values() for name, module in group.items()}

_PAGE = """usage: keyss COMMAND [OPTIONS]

Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.
{commands}

`keyss COMMAND --help` shows the options of a command and examples.

  -q, --quiet              print nothing but paths of results, and errors
  -v, --verbose            show more progress, and the time at the end
  -V, --version            print the version
  --completion {{bash,zsh}}  print a completion script for the shell

A key is read from --key-file, from the environment variable KEYSS_KEY, or from a prompt.
Exit status: 0 done, 2 wrong usage, 3 wrong key, 4 unreadable input, 5 unwritable output,
6 missing backend, 7 failed quality check, 8 out of memory, 70 internal error,
130 interrupted, 141 broken pipe, 143 terminated."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `keyss` with `arguments` (those of the process by default); returns the exit status.

    Raises SystemExit for --help and for arguments that cannot be parsed, as argument parsers do. With
    KEYSS_DEBUG=1 in the environment, internal errors are raised.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options: dict[str, Any] = {}  # options of the command, by their names in Python
    try:
        with _warnings_as_lines(options), _verbosity(arguments) as words:
            try:
                _run(words or ["--help"], options)
            finally:
                _flush()
        return 0
    except BrokenPipeError:
        # Otherwise the interpreter would flush the buffer again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        status, message = explain(_interrupt_behind(error) or error)
        if status == INTERNAL_ERROR and os.environ.get("KEYSS_DEBUG") == "1":
            raise
        print(f"keyss: {_one_line(as_flags(message, options))}", file=sys.stderr)
        return status


def _run(arguments: list[str], options: dict[str, Any]) -> None:
    """Run the command that `arguments` name; its options are added to `options`."""
    name, *rest = arguments
    if arguments in (["--version"], ["-V"]):  # needs no argument parser, whose import is slow
        print(__version__)
        return

    import tyro

    if arguments in (["--help"], ["-h"]):
        print(help_page())
        return
    if name == "--completion":
        _print_completion(rest)
        return
    if name not in MODULES:
        raise UsageError(f"there is no command {name!r}: {did_you_mean(name.lower(), MODULES)}")
    if any(word.partition("=")[0] in _KEY_OPTIONS for word in rest):  # the parser would print its value
        raise UsageError(
            "a key cannot be an argument, which other users could see: give --key-file FILE, set KEYSS_KEY, "
            "or type it at the prompt"
        )
    target = parse_target(name, rest)
    options.update(options_of(target))
    _check_spelling(name, rest, options)
    tyro.cli(target, prog=f"keyss {name}", args=rest, config=(tyro.conf.FlagCreatePairsOff,))


def _check_spelling(command: str, words: list[str], options: dict[str, Any]) -> None:
    """Raise UsageError with a suggestion for misspelt options and values; tyro names missing ones first."""
    from keyss.cli.arguments import flag

    known = {"--help": [], **{flag(option): _choices(hint) for option, hint in options.items()}}
    for word, value in pairwise([*words, ""]):
        given = word.partition("=")[0].replace("_", "-")
        if (choices := known.get(given)) and given == word and value not in choices:
            raise UsageError(f"{given}: expected one of {', '.join(choices)}, got {value!r}")
        if given.startswith("--") and given not in known and (near := nearest(given, known)):
            raise UsageError(f"`keyss {command}` has no option {given}: did you mean {near}?")


def _choices(hint: Any) -> list[str]:
    """The values of an option that has a few; empty for any other."""
    if get_origin(hint) is Literal:
        return [str(value) for value in get_args(hint)]
    if get_origin(hint) in (Annotated, Union, UnionType):
        return [value for part in get_args(hint) for value in _choices(part)]
    return []


def _print_completion(arguments: list[str]) -> None:
    import tyro

    if arguments not in (["bash"], ["zsh"]):
        raise UsageError("--completion: expected bash or zsh")
    app = tyro.extras.SubcommandApp()
    for name in MODULES:
        app.command(name=name)(parse_target(name, []))
    printing = ["--tyro-print-completion", *arguments]
    app.cli(prog="keyss", args=printing, config=(tyro.conf.FlagCreatePairsOff,))


def command(name: str) -> Callable[..., None]:
    """The function of a command."""
    function: Callable[..., None] = getattr(importlib.import_module(f"keyss.{MODULES[name]}"), name)
    return function


def parse_target(name: str, arguments: Sequence[str]) -> Callable[..., None]:
    """The function to parse: for `hide`, with the options of the method named in `arguments`."""
    if name == "hide":
        from keyss.cli.hide_command import with_options_of_method

        return with_options_of_method(arguments)
    return command(name)


def help_page() -> str:
    """The text of `keyss --help`: a line for each command."""
    lines = []
    for group, names in GROUPS.items():
        lines += ["", f"{group}:"]
        for name in names:
            summary = (command(name).__doc__ or "").partition("\n")[0]
            lines.append(f"  {name:<12} {summary}")
    return _PAGE.format(commands="\n".join(lines))


def explain(error: BaseException) -> tuple[int, str]:
    """The exit status and the message of an error."""
    match error:
        case KeyssError():
            return error.exit_status, f"error: {error}"
        case KeyboardInterrupt():
            signum = signal_of(error)
            word = "interrupted" if signum == signal.SIGINT else "terminated"
            if isinstance(error, Interrupted):
                saved = "nothing was saved"
                if error.checkpoint is not None:
                    saved = "continue with the same command and `resume=True`"
                where = "" if error.iteration is None else f" at iteration {error.iteration}"
                word += f"{where}; {saved}"
            return 128 + signum, word
        case _ if _is_out_of_memory(error):
            return OUT_OF_MEMORY, (
                "error: out of memory; smaller models and images "
                f"(`width`, `max_gaussians`) need less ({type(error).__name__}: {error})"
            )
        case ModuleNotFoundError():
            return BackendError.exit_status, f"error: the package {error.name} is missing: see `keyss doctor`"
        case OSError():
            where = f"{error.filename}: " if error.filename is not None else ""
            return OutputError.exit_status, f"error: {where}{error.strerror or error}"
    return INTERNAL_ERROR, (
        f"internal error: {type(error).__name__}: {error}; please report it; "
        "run with KEYSS_DEBUG=1 for the traceback"
    )


@contextmanager
def _warnings_as_lines(options: Collection[str]) -> Iterator[None]:
    """Print each distinct KeyssWarning once, as one line on the standard error stream."""
    said: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", KeyssWarning)
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, KeyssWarning):
                otherwise(message, category, *where, **more)
            elif (line := _one_line(as_flags(str(message), options))) not in said:
                said.add(line)
                print(f"keyss: warning: {line}", file=sys.stderr)

        warnings.showwarning = show
        yield


@contextmanager
def _verbosity(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Yield `arguments` without -q and -v. With -v, prints the time unless the context raises an error."""
    levels = [_LEVELS[word] for word in arguments if word in _LEVELS]
    if not levels:  # avoids importing the progress module
        yield list(arguments)
        return

    from keyss import progress

    before, start = progress.level, time.monotonic()
    progress.level = levels[-1]
    try:
        yield [word for word in arguments if word not in _LEVELS]
        if progress.level > 0:
            print(f"keyss: done in {time.monotonic() - start:.1f} s", file=sys.stderr)
    finally:
        progress.level = before


def _interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interrupt in the chain of causes and contexts of `error`, if any."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def _flush() -> None:
    try:
        sys.stdout.flush()
    except OSError as error:
        error.filename = "the standard output"
        raise


def _is_out_of_memory(error: BaseException) -> bool:
    """True for out-of-memory errors of Python and PyTorch, on the CPU or a GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def _one_line(message: str) -> str:
    """`message` without line breaks and control characters, e.g. from file names."""
    return " ".join("".join(c if c.isprintable() else " " for c in message).split())


def as_flags(message: str, options: Collection[str]) -> str:
    """Replace arguments between backticks in `message` by flags, such as `width=200, overwrite=True`.

    Names without a value are replaced only if they are in `options`.
    """

    def flags(quoted: re.Match[str]) -> str:
        words = []
        for name, is_set, value in (part.strip().partition("=") for part in quoted[1].split(",")):
            option = _RENAMED.get(name, name)
            if not name.isidentifier() or not (is_set or option in options):
                return quoted[0]
            words.append(f"--{option.replace('_', '-')}")
            words += [value.strip("\"'")] if value not in ("", "True") else []
        return " ".join(words)

    return re.sub("`([^`]*)`", flags, message)


def options_of(target: Any) -> dict[str, Any]:
    """Names and types of the options of a command, those of groups included."""
    from tyro.conf import Positional

    options: dict[str, Any] = {}
    for name, hint in get_type_hints(target, include_extras=True).items():
        if is_dataclass(group := getattr(hint, "__origin__", hint)):
            options |= options_of(group)
        elif name != "return" and Positional not in getattr(hint, "__metadata__", ()):
            options[name.rstrip("_")] = hint
    return options
