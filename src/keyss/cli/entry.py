"""The entry point: picks the command, and turns whatever goes wrong into a line and an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import tyro

from keyss.cli import commands
from keyss.cli.hiding import hide, hide_with_options
from keyss.cli.models import fit, fit_with_presets

INTERRUPTED = 130  # 128 + SIGINT, as a shell counts
BROKEN_PIPE = 141  # 128 + SIGPIPE
INTERNAL_ERROR = 70  # EX_SOFTWARE
NO_ROOM = 5  # that of OutputError

_ABOUT = """Hide a 3D Gaussian Splatting scene inside another one and open it only with a key.

A key comes from --key-file, from the environment variable KEYSS_KEY, or from a hidden prompt. Results go to
the standard output, progress and errors to the standard error stream."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `keyss` with `arguments` (those of the process by default); returns the exit status.

    Raises SystemExit for --help and for arguments that cannot be parsed, as argument parsers do. With
    KEYSS_DEBUG=1 in the environment, errors that are not a person's come through as they are.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    app = tyro.extras.SubcommandApp()
    try:
        for command in commands.ALL:
            if command is hide and arguments[:1] == ["hide"]:
                app.command(hide_with_options(arguments))
            elif command is fit and arguments[:1] == ["fit"]:
                app.command(fit_with_presets())
            else:
                app.command(command)
        app.cli(prog="keyss", description=_ABOUT, args=arguments, config=(tyro.conf.FlagCreatePairsOff,))
        sys.stdout.flush()
        return 0
    except BrokenPipeError:
        # Whoever read our output has left; the interpreter must not try to flush what is still buffered.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        status, message = explain(error)
        if status == INTERNAL_ERROR and os.environ.get("KEYSS_DEBUG") == "1":
            raise
        print(f"keyss: {_one_line(message)}", file=sys.stderr)
        return status


def explain(error: BaseException) -> tuple[int, str]:
    """(exit status, what to tell a person) of an error."""
    from keyss.core.errors import KeyssError
    from keyss.fitting.loop import Interrupted

    match error:
        case KeyssError():
            return error.exit_status, f"error: {error}"
        case Interrupted(checkpoint=None):
            return INTERRUPTED, f"interrupted at iteration {error.iteration}; nothing was saved"
        case Interrupted():
            return INTERRUPTED, (
                f"interrupted at iteration {error.iteration}; continue with the same command and --resume"
            )
        case KeyboardInterrupt():
            return INTERRUPTED, "interrupted"
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


def _is_out_of_memory(error: BaseException) -> bool:
    """Python's, or what PyTorch raises on the CPU and on a GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def _one_line(message: str) -> str:
    """`message` without line breaks and control characters: names of files may hold any."""
    return " ".join("".join(c if c.isprintable() else " " for c in message).split())
