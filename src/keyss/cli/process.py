"""The process around the command line: signals, standard streams, and how it ends.

Python turns Ctrl-C into an exception wherever it happens to be. In the middle of an import that is a
traceback, or worse: native libraries such as torch's do not survive being loaded half, and crash when they
are loaded again or when the interpreter shuts down. So this module, which imports next to nothing, is ready
for signals before anything else is loaded, and ends the process itself.
"""

from __future__ import annotations

import atexit
import io
import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # the last one is not everywhere
_IMPORTING = "<frozen importlib._bootstrap>"
_CLEAR_LINE = b"\r\x1b[K\x1b[?25h"  # and show the cursor, which a progress line hides


def main() -> NoReturn:
    """Run the command line as a process of its own, to its end."""
    _Process().run()


class _Process:
    def __init__(self) -> None:
        self.received: int | None = None  # the first signal
        self.running = False  # inside a command, which cleans up when it is interrupted
        self.status: int | None = None  # of a command that is done

    def run(self) -> NoReturn:
        for name in _SIGNALS:
            signum = getattr(signal, name, None)
            # What is ignored stays so: `nohup`, and commands that a script runs in the background.
            if signum is not None and signal.getsignal(signum) is not signal.SIG_IGN:
                signal.signal(signum, self.on_signal)
        sys.unraisablehook = self.on_unraisable
        prepare_streams()
        try:
            self.running = True
            from keyss.cli.entry import main

            self.status = main()
        except SystemExit as end:
            self.status = end.code if isinstance(end.code, int) else int(bool(end.code))
        except KeyboardInterrupt as interrupt:
            self.received = self.received or (interrupt.args[0] if interrupt.args else signal.SIGINT)
        if self.received is not None:
            # Not through the interpreter's shutdown, which does not stand up to what was interrupted.
            if self.status in (None, 0):
                self.end(self.received)
            os._exit(128 + self.received)
        atexit._run_exitfuncs()
        os._exit(self.status or 0)

    def on_signal(self, signum: int, frame: FrameType | None) -> None:
        if self.status is not None:
            os._exit(self.status)  # all is done, only Python is still closing
        first, self.received = self.received is None, self.received or signum
        if not (first and self.running) or _is_importing(frame):
            self.end(self.received)
        raise KeyboardInterrupt(signum)

    def on_unraisable(self, unraisable: Any) -> None:
        """Python drops an exception that comes up where none can, such as a callback of native code."""
        if self.received is not None and isinstance(unraisable.exc_value, KeyboardInterrupt):
            self.end(self.received)
        sys.__unraisablehook__(unraisable)

    def end(self, signum: int) -> NoReturn:
        """At once, with one line and nothing else: whatever runs may be half done."""
        line = f"keyss: {'interrupted' if signum == signal.SIGINT else 'terminated'}\n".encode()
        try:
            os.write(2, _CLEAR_LINE * os.isatty(2) + line)
        finally:
            os._exit(128 + signum)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTING:
            return True
        frame = frame.f_back
    return False


class _Unfailing(io.FileIO):
    """A stream for messages: where they cannot be written, work goes on without them."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data) or 0
        except OSError:
            return len(data)


def prepare_streams() -> None:
    """Make the standard streams ones that are there and take every character.

    A stream that is closed becomes one that is empty: the next file that is opened must not get its number,
    or what is printed ends up in a result.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
    file = io.BufferedWriter(_Unfailing(2, "w", closefd=False))
    sys.stderr = io.TextIOWrapper(file, encoding, "backslashreplace", line_buffering=True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            from keyss.cli.characters import REPLACING

            stream.reconfigure(errors=REPLACING)
