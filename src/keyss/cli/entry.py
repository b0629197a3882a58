"""The entry point: picks the command, and turns whatever goes wrong into a line and an exit status."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from keyss import __version__
from keyss.cli import ranks
from keyss.cli.flags import as_flags
from keyss.cli.verbosity import spoken
from keyss.core.errors import InputError, Interrupted, KeyssError, KeyssWarning, OutputError, signal_of

if TYPE_CHECKING:
    import tyro

BROKEN_PIPE = 141  # 128 + SIGPIPE, as a shell counts
INTERNAL_ERROR = 70  # EX_SOFTWARE
NO_ROOM = OutputError.exit_status

_ABOUT = """Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

A key comes from --key-file, from the environment variable KEYSS_KEY, or from a hidden prompt. Results go to
the standard output, progress and errors to the standard error stream. `keyss --version` tells the version.

-q (--quiet) leaves progress out, -v (--verbose) adds to it, and time and memory at the end; every command
takes them. `keyss completion bash` prints what completes commands and options in a shell."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `keyss` with `arguments` (those of the process by default); returns the exit status.

    Raises SystemExit for --help and for arguments that cannot be parsed, as argument parsers do. With
    KEYSS_DEBUG=1 in the environment, errors that are not a person's come through as they are.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options: set[str] = set()  # of the command, as Python names them
    try:
        with ranks.one_speaks(), _warnings_as_lines(options), spoken(arguments) as asked:
            try:
                _run(asked or ["--help"], options)
            finally:
                _flush()
        return 0
    except BrokenPipeError:
        # Whoever read our output has left; the interpreter must not try to flush what is still buffered.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        status, message = explain(_interrupt_behind(error) or error)
        if status == INTERNAL_ERROR and os.environ.get("KEYSS_DEBUG") == "1":
            raise
        if isinstance(error, InputError):
            from keyss.cli.suggestions import existing_path

            near = existing_path(message, arguments)
            message += f"; did you mean {near}?" if near else ""
        if ranks.has_to_say(error):
            print(f"keyss: {ranks.name()}{_one_line(as_flags(message, options))}", file=sys.stderr)
        return status


def _run(arguments: list[str], options: set[str]) -> None:
    """The command that `arguments` ask for; its options are added to `options`."""
    if arguments in (["--version"], ["-V"], ["version"]):  # without what parses arguments, which takes longer
        print(__version__)
        return

    from keyss.cli import suggestions
    from keyss.cli.commands import ALL

    ranks.check_command(arguments[0])
    commands = application(arguments)
    flags = set()
    if (chosen := commands.found.get(arguments[0])) is not None:
        flags = suggestions.options_of(chosen)
        options |= {flag.removeprefix("--").replace("-", "_") for flag in flags}
    try:
        commands.run(arguments)
    except SystemExit as end:
        names = [name_of(command) for command in ALL]
        if end.code not in (None, 0) and (meant := suggestions.meant(arguments, names, flags)):
            print(f"keyss: did you mean {meant}?", file=sys.stderr)
        raise


@dataclass(frozen=True)
class Application:
    """The commands, as they are parsed."""

    found: Mapping[str, Callable[..., None]]
    app: tyro.extras.SubcommandApp

    def run(self, arguments: Sequence[str]) -> None:
        """Parses and calls. Raises SystemExit."""
        import tyro

        config = (tyro.conf.FlagCreatePairsOff,)
        self.app.cli(prog="keyss", description=_ABOUT, args=arguments, config=config)


def application(arguments: Sequence[str], *, whole: bool = False) -> Application:
    """All commands; the one asked for, or all, with what takes time to load: presets, methods."""
    import tyro

    from keyss.cli import commands
    from keyss.cli.hiding import hide
    from keyss.cli.hiding_options import hide_with_options
    from keyss.cli.models import fit, fit_with_presets

    found: dict[str, Callable[..., None]] = {}
    for command in commands.ALL:
        name, asked = name_of(command), command
        if command is hide and (whole or name == arguments[0]):
            asked = hide_with_options(hide, arguments)
        elif command is fit and (whole or name == arguments[0]):
            asked = fit_with_presets()
        found[name] = asked
    app = tyro.extras.SubcommandApp()
    for asked in found.values():
        app.command(asked)
    return Application(found, app)


def name_of(command: Callable[..., None]) -> str:
    """What a command is called on the command line."""
    return command.__name__.replace("_", "-")


def explain(error: BaseException) -> tuple[int, str]:
    """(exit status, what to tell a person) of an error."""
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
            return NO_ROOM, (
                "error: not enough memory; a smaller --width or --max-gaussians takes less "
                f"({type(error).__name__}: {error})"
            )
        case OSError():
            where = f"{error.filename}: " if error.filename is not None else ""
            return NO_ROOM, f"error: {where}{error.strerror or error}"
    return INTERNAL_ERROR, (
        f"internal error: {type(error).__name__}: {error}; please report it; "
        "run with KEYSS_DEBUG=1 for the traceback"
    )


@contextmanager
def _warnings_as_lines(options: Collection[str]) -> Iterator[None]:
    """Prints what keyss warns of as one line on the standard error stream, each once."""
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


def _interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """What came up while an interrupt was handled, or was made of one, is no error of its own."""
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
    """Python's, or what PyTorch raises on the CPU and on a GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def _one_line(message: str) -> str:
    """`message` without line breaks and control characters: names of files may hold any."""
    return " ".join("".join(c if c.isprintable() else " " for c in message).split())
