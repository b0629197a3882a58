"""-q and -v, which every command takes: how much is printed on the standard error stream."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_LEVELS = {"-q": -1, "--quiet": -1, "-v": 1, "--verbose": 1}


@contextmanager
def verbosity(arguments: Sequence[str]) -> Iterator[list[str]]:
    """`arguments` without -q and -v. With -v, prints time and memory unless the context ends by an error."""
    asked = [_LEVELS[word] for word in arguments if word in _LEVELS]
    if not asked:  # without importing what shows progress
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
    """The peak memory of this process and of the largest one that it started, if the system knows."""
    try:
        import resource
    except ImportError:
        return ""
    unit = 1 if sys.platform == "darwin" else 1024
    own, others = (
        f"{resource.getrusage(whose).ru_maxrss * unit / 1e6:,.0f} MB"
        for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    besides = f", and {others} in another process" if others != "0 MB" else ""
    return f", with at most {own} of memory{besides}"
