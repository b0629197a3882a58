"""The kernels compiled for processors without AVX2, with vectors of two or four numbers."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from keyss.kernels import jit
from rendering import child_process

# Colours and features, one and several cameras; forward and backward.
SCENES = ("random", "three cameras, features")


@pytest.mark.slow
def test_images_and_gradients_without_avx2() -> None:
    """In a child process, since the processor is chosen once; the compiled kernels are cached."""
    cache = jit.cache_folder()
    assert cache is not None
    program = (
        f"from rendering.child_process import check_on_generic_processor as check; print(check({SCENES!r}))"
    )
    done = child_process.python(
        program,
        NUMBA_CPU_NAME="generic",
        NUMBA_CPU_FEATURES="",
        NUMBA_CACHE_DIR=str(cache.parent / "generic"),
        PYTHONPATH=os.pathsep.join([str(Path(child_process.__file__).parents[1]), *sys.path]),
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == ["generic"]
