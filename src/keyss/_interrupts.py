"""Ctrl-C while the command line is loading, before `keyss.cli.process` handles signals: no traceback."""

import _signal  # type: ignore[import-not-found]  # `signal` takes 10 ms to import
import os
import sys

# Signals that end a command. Windows has no SIGHUP.
ENDING = tuple(getattr(_signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(_signal, name))


def _end(signum: int, frame: object) -> None:
    os.write(2, b"keyss: interrupted\n")
    os._exit(128 + signum)


# Only in a process of our own: elsewhere signals belong to the program that imports keyss.
if (
    os.path.basename(sys.argv[0] if sys.argv else "") in ("keyss", "keyss.exe")
    or sys.orig_argv[1:3] == ["-m", "keyss"]
) and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _end)
