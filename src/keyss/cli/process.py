"""The process of the command line: signals, standard streams, exit.

On Ctrl-C, Python raises an exception at any point. During imports and at the interpreter's shutdown this
prints a traceback or crashes half-loaded native libraries. Therefore this module imports little, installs
signal handlers before other imports, and ends the process itself.
"""

from __future__ import annotations

import atexit
import codecs
import io
import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn

from keyss._interrupts import ENDING

_IMPORTING = "<frozen importlib._bootstrap>"
_CLEAR_LINE = b"\r\x1b[K\x1b[?25h"  # and show the cursor, which progress lines hide
REPLACING = "keyss.replacing"  # a handler of encoding errors


def main() -> NoReturn:
    """Run the command line, and exit."""
    _Process().run()


class _Process:
    def __init__(self) -> None:
        self.received: int | None = None  # the first signal
        self.running = False  # inside a command, which cleans up on an interrupt
        self.status: int | None = None  # exit status; None while the command runs

    def run(self) -> NoReturn:
        for signum in ENDING:
            # Ignored signals stay ignored: `nohup`, and background commands of scripts.
            if signal.getsignal(signum) is not signal.SIG_IGN:
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
            # The interpreter's shutdown could crash after an interrupt.
            if self.status in (None, 0):
                self.end(self.received)
            os._exit(128 + self.received)
        atexit._run_exitfuncs()
        os._exit(self.status or 0)

    def on_signal(self, signum: int, frame: FrameType | None) -> None:
        if self.status is not None:
            os._exit(self.status)  # the interpreter is shutting down
        first, self.received = self.received is None, self.received or signum
        if not (first and self.running) or _is_importing(frame):
            self.end(self.received)
        raise KeyboardInterrupt(signum)

    def on_unraisable(self, unraisable: Any) -> None:
        """Handle interrupts that Python only reports, such as those in callbacks of native code."""
        if self.received is not None and isinstance(unraisable.exc_value, KeyboardInterrupt):
            self.end(self.received)
        sys.__unraisablehook__(unraisable)

    def end(self, signum: int) -> NoReturn:
        """Exit immediately with one line: any operation may be incomplete."""
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
    """A stream that drops messages on write errors."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data) or 0
        except OSError:
            return len(data)


def prepare_streams() -> None:
    """Ensure that the standard streams are open and accept every character.

    Closed streams are opened on the null device: otherwise the next opened file would get their descriptor,
    and receive messages.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if os.name == "posix":  # a console of Windows takes UTF-16, not the bytes of a file
        encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
        file = io.BufferedWriter(_Unfailing(2, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(file, encoding, "backslashreplace", line_buffering=True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=REPLACING)


def _replace(error: UnicodeError) -> tuple[str | bytes, int]:
    """`?` for a character that the encoding lacks; undecodable bytes of a file name do not change."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    first = error.object[error.start]
    if "\udc80" <= first <= "\udcff":
        return bytes([ord(first) - 0xDC00]), error.start + 1
    return "?", error.start + 1


codecs.register_error(REPLACING, _replace)
