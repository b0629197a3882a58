"""The cache of compiled kernels: its folder, and rendering without one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from keyss.kernels import jit
from rendering.child_process import SOURCE, python


def add_one(x: float) -> float:
    return x + 1.0


@pytest.fixture(autouse=True)
def _clear_cache() -> Iterator[None]:
    yield
    jit.cache_folder.cache_clear()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have no owners and modes here")
def test_unsafe_cache_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "shared"
    place.mkdir()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(place / "cache"))

    def is_used() -> bool:
        jit.cache_folder.cache_clear()
        found = jit.cache_folder()
        return found is not None and found.is_relative_to(place)

    for mode, is_safe in ((0o700, True), (0o777, False), (0o775, False), (0o1777, True)):
        place.chmod(mode)
        assert is_used() == is_safe, oct(mode)
    (folder,) = (place / "cache").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert not is_used()
    folder.chmod(0o700)
    another = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: another)  # as if another user owned the folder
    assert not is_used()


def test_cache_folder_is_recreated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    jit.cache_folder.cache_clear()
    compiled = jit.kernel(add_one)
    (folder,) = tmp_path.iterdir()
    shutil.rmtree(folder)
    assert compiled(np.float32(1)) == 2
    assert list(folder.rglob("*.nbi"))


DRAW = """
import torch
from keyss.rendering import rasterization
image, _, _ = rasterization(
    torch.tensor([[0.0, 0, 1]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3),
    torch.eye(4), torch.tensor([[4.0, 0, 4], [0, 4, 4], [0, 0, 1]]), 8, 8,
)
assert image.max() > 0.9
"""


@pytest.mark.slow
def test_render_without_cache(tmp_path: Path) -> None:
    # Files in place of folders block even root.
    copy = tmp_path / "source"
    shutil.copytree(SOURCE / "keyss", copy / "keyss", ignore=shutil.ignore_patterns("__pycache__"))
    blocked = copy / "keyss" / "rendering" / "cpu" / "__pycache__"
    blocked.write_text("")
    places = {name: str(blocked) for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA", "HOME")}
    done = python(DRAW, copy, PYTHONDONTWRITEBYTECODE="1", **places)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compiling the CPU rasterizer") == done.stderr.count("\n") == 1


@pytest.mark.slow
def test_compilation_is_announced_once(tmp_path: Path) -> None:
    for times in (1, 0):
        done = python(DRAW, NUMBA_CACHE_DIR=str(tmp_path))
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("compiling the CPU rasterizer") == done.stderr.count("\n") == times
    assert list(tmp_path.rglob("*.nbi"))
