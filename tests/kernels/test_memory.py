"""Memory that is given back to the system."""

from __future__ import annotations

import ctypes
import sys

import numpy as np
import psutil
import pytest

from keyss.kernels.memory import release

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc"
)


def test_release_gives_back_what_small_arrays_took() -> None:
    arrays = [np.ones(10_000) for _ in range(2000)]  # 160 MB
    kept = arrays[::100]  # the C library gives back by itself only what lies above them
    del arrays
    before = psutil.Process().memory_info().rss
    release()
    assert before - psutil.Process().memory_info().rss > 100e6
    assert all((array == 1).all() for array in kept)
