"""-q and -v, which every command takes: how much is said on the standard error stream."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_LEVELS = {"-q": -1, "--quiet": -1, "-v": 1, "--verbose": 1}


@contextmanager
def spoken(arguments: Sequence[str]) -> Iterator[list[str]]:
    """`arguments` without -q and -v; at the end of a command that went well, -v tells time and memory."""
    asked = [_LEVELS[word] for word in arguments if word in _LEVELS]
    if not asked:  # without loading what shows progress
        yield list(arguments)
        return

    from keyss import progress

    before, start = progress.level, time.monotonic()
    progress.level = asked[-1]
    try:
        yield [word for word in arguments if word not in _LEVELS]
        if progress.level > 0:
            print(f"keyss: done in {time.monotonic() - start:.1f} s{_memory()}", file=sys.stderr)
    finally:
        progress.level = before


def _memory() -> str:
    """The most that this process has had, where the system tells."""
    try:
        import resource
    except ImportError:
        return ""
    unit = 1 if sys.platform == "darwin" else 1024
    own, others = (
        f"{resource.getrusage(whose).ru_maxrss * unit / 1e6:,.0f} MB"
        for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    # Of processes that it started, such as those that fit models side by side, the system tells the largest.
    besides = f", and {others} in another process" if others != "0 MB" else ""
    return f", with at most {own} of memory{besides}"
