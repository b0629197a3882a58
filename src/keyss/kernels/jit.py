"""Decorators that compile kernels and cache the code.

numba's cache detects changes of the file that contains a kernel, but not of files it imports. Therefore all
kernels share a cache folder whose name is a hash of every source file in this package, and of the only
constant imported from outside.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba

from keyss.core.gaussians import DRAWN_OPACITY

_PACKAGE = Path(__file__).parents[1]
_numba: Any = numba  # typed in some versions only

# `fastmath` without the assumption that there are no NaN and infinities: a Gaussian with a NaN must fail the
# comparisons that select it, not index out of bounds.
_NAN_SAFE = {"contract", "arcp", "nsz", "reassoc", "afn"}


def _compile(function: Any, fastmath: bool | set[str], forceinline: bool = False) -> Any:
    """Compile `function` at its first call."""
    # Inlined functions borrow the kernel's arrays: reference counting would cost more than some arithmetic.
    options = {"fastmath": fastmath, "forceinline": forceinline, "error_model": "numpy", "nogil": True}
    options["_nrt"] = not forceinline
    folder = cache_folder()
    if folder is None:
        return _numba.njit(**options)(function)
    # numba reads the cache folder when a kernel is decorated.
    folder_before = _numba.config.CACHE_DIR
    _numba.config.CACHE_DIR = str(folder)
    try:
        return _numba.njit(cache=True, **options)(function)
    except RuntimeError:  # the folder was removed, and numba's own are not writable
        return _numba.njit(**options)(function)
    finally:
        _numba.config.CACHE_DIR = folder_before


# NaN and infinity compare as in IEEE 754.
kernel = partial(_compile, fastmath=_NAN_SAFE)
# The compiler may assume that all numbers are finite.
finite_kernel = partial(_compile, fastmath=True)
# Inlined into the kernels that call them: LLVM does not inline large functions by itself. A process that
# compiles them would call the separate code, one that loads the cached kernel the code optimised with it, and
# the two round differently.
inline = partial(_compile, fastmath=_NAN_SAFE, forceinline=True)
finite_inline = partial(_compile, fastmath=True, forceinline=True)


@cache
def cache_folder() -> Path | None:
    """The cache folder for kernels of exactly these sources; None if there is no safe place.

    It is in the first of `NUMBA_CACHE_DIR`, `__pycache__` beside this file and the user's cache that only
    this user can write to, because numba unpickles its content.
    """
    digest = hashlib.sha256(repr(DRAWN_OPACITY).encode())
    for source in sorted([*_PACKAGE.glob("kernels/*.py"), *_PACKAGE.glob("rendering/cpu/*.py")]):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    for parent in _cache_parents():
        folder = parent / f"keyss-kernels-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                if _is_private(folder):
                    return folder
        except OSError:
            continue
    return None


def _is_private(folder: Path) -> bool:
    """True if nobody but this user and root can change or replace a folder. Raises OSError."""
    if not hasattr(os, "getuid"):  # Windows, where folders inherit their owner's rights
        return True
    folder = folder.resolve()
    states = [parent.stat() for parent in (folder, *folder.parents)]
    return states[0].st_uid == os.getuid() and all(
        state.st_uid in (0, os.getuid()) and (not state.st_mode & 0o022 or state.st_mode & stat.S_ISVTX)
        for state in states
    )


def _cache_parents() -> list[Path]:
    of_user = (
        os.environ.get("LOCALAPPDATA") or os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    )
    parents = (_numba.config.CACHE_DIR, _PACKAGE / "kernels" / "__pycache__", of_user)
    return [Path(name) for name in parents if name and not str(name).startswith("~")]  # no home folder


@cache
def announce_compilation() -> None:
    """Print once to stderr that the first render takes a while, if nothing is compiled yet."""
    folder = cache_folder()
    # numba names folders after those of the sources.
    if folder is None or next(folder.glob("cpu_*/*.nbi"), None) is None:
        print("keyss: compiling the CPU rasterizer, 10 to 20 s, once", file=sys.stderr, flush=True)
