"""How the kernels are compiled, and where the compiled code is kept.

numba's cache notices a change of the file that holds a kernel, but not of the files it imports. All
kernels here share one cache folder whose name is a hash of every source file in this package, and of the
one number that kernels have from elsewhere, so any change makes a new folder.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba

from keyss.core.gaussians import DRAWN_OPACITY

_numba: Any = numba  # typed in some versions only

# Everything `fastmath` allows except assuming that no NaN and no infinity occurs: a Gaussian with a NaN
# must fail the comparisons that select it, not index wildly.
_NAN_SAFE = {"contract", "arcp", "nsz", "reassoc", "afn"}


def kernel(function: Any) -> Any:
    """Compile `function` at its first call; NaN and infinity compare as IEEE says."""
    return _compiled(function, fastmath=_NAN_SAFE)


def finite_kernel(function: Any) -> Any:
    """Compile `function` at its first call; the compiler may assume that all numbers are finite."""
    return _compiled(function, fastmath=True)


def exact_kernel(function: Any) -> Any:
    """Compile `function` at its first call; it computes what the source says, in that order, as IEEE says."""
    return _compiled(function, fastmath=False)


def inlined(function: Any) -> Any:
    """For functions that only kernels call: their code becomes part of the kernel's.

    LLVM would leave large ones as functions. Those exist twice, by themselves and optimised along with the
    kernel; a process that compiles calls the first and one that loads from the cache the second, and the
    two round differently.
    """
    return _compiled(function, fastmath=_NAN_SAFE, forceinline=True)


def finite_inlined(function: Any) -> Any:
    """`inlined`, for functions that only a `finite_kernel` calls."""
    return _compiled(function, fastmath=True, forceinline=True)


def exact_inlined(function: Any) -> Any:
    """`inlined`, for functions that only an `exact_kernel` calls."""
    return _compiled(function, fastmath=False, forceinline=True)


def _compiled(function: Any, fastmath: bool | set[str], forceinline: bool = False) -> Any:
    # What is inlined borrows the arrays of the kernel: to count references to them would take longer than
    # some of the arithmetic.
    options = {"fastmath": fastmath, "forceinline": forceinline, "error_model": "numpy", "nogil": True}
    options["_nrt"] = not forceinline
    folder = cache_folder()
    if folder is None:
        return _numba.njit(**options)(function)
    # A kernel takes the cache folder of the moment in which it is decorated.
    folder_before = _numba.config.CACHE_DIR
    _numba.config.CACHE_DIR = str(folder)
    try:
        return _numba.njit(cache=True, **options)(function)
    except RuntimeError:  # the folder went away, and numba's own places are not writable either
        return _numba.njit(**options)(function)
    finally:
        _numba.config.CACHE_DIR = folder_before


@cache
def cache_folder() -> Path | None:
    """Where the compiled kernels of exactly these sources are kept; None where nothing is writable.

    The first writable of: `NUMBA_CACHE_DIR`, `__pycache__` beside this file, the user's cache folder.
    """
    digest = hashlib.sha256(repr(DRAWN_OPACITY).encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    for parent in _cache_parents():
        folder = parent / f"keyss-kernels-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


def _cache_parents() -> list[Path]:
    parents = [Path(__file__).parent / "__pycache__"]
    if _numba.config.CACHE_DIR:
        parents.insert(0, Path(_numba.config.CACHE_DIR))
    user_cache = os.environ.get("LOCALAPPDATA") or os.environ.get("XDG_CACHE_HOME")
    if user_cache:
        parents.append(Path(user_cache))
    else:
        with suppress(RuntimeError):  # no home folder is known
            parents.append(Path.home() / ".cache")
    return parents


@cache
def announce_compilation() -> None:
    """Say on stderr that the first render takes a while, if nothing is compiled yet. Says it once."""
    folder = cache_folder()
    if folder is None or next(folder.rglob("*.nbi"), None) is None:
        print("keyss: compiling the CPU rasterizer, 10 to 20 s, once", file=sys.stderr, flush=True)
