"""Memory for the kernels is used again, and never by two at once."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from keyss.rendering.cpu import memory


@pytest.fixture(autouse=True)
def _nothing_free(monkeypatch: pytest.MonkeyPatch) -> None:
    gc.collect()
    monkeypatch.setattr(memory, "_free", {})


def test_a_buffer_is_used_again_only_after_its_last_array_is_gone() -> None:
    first = memory.empty((1000, 100), np.float32)
    address = first.ctypes.data
    assert address % 64 == 0
    view = first[10:].reshape(-1)
    del first
    other = memory.empty((1000, 100), np.float32)
    assert not np.shares_memory(other, view)
    del view
    again = memory.empty((1000, 90), np.int32)
    assert again.ctypes.data == address
    assert again.shape == (1000, 90)
    assert again.dtype == np.int32


def test_free_memory_is_bounded() -> None:
    for size in range(1, 200):
        memory.empty((size * 100_000,), np.uint8)
    assert len(memory._free) <= memory.MAX_FREE + 1


def test_arrays_may_be_empty() -> None:
    assert memory.empty((0, 16), np.float32).shape == (0, 16)
