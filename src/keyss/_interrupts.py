"""Ctrl-C while the command line is loading, before `keyss.cli.process` handles signals: no traceback."""

import os
import signal
import sys
from types import FrameType


def _end(signum: int, frame: FrameType | None) -> None:
    os.write(2, b"keyss: interrupted\n")
    os._exit(128 + signum)


# Only in a process of our own: elsewhere signals belong to the program that imports keyss.
if (
    os.path.basename(sys.argv[0] if sys.argv else "") == "keyss" or sys.orig_argv[1:3] == ["-m", "keyss"]
) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end)
