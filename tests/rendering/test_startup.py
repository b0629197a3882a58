"""Importing compiles nothing, and rendering works in any state of the kernel cache."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rendering.child_process import SOURCE, python

DRAW = """
import torch
from keyss.rendering import rasterization
images, _, _ = rasterization(
    torch.tensor([[0.0, 0, 1]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3),
    torch.eye(4)[None], torch.tensor([[[4.0, 0, 4], [0, 4, 4], [0, 0, 1]]]), 8, 8,
)
assert images.max() > 0.9
"""

LIST_COMPILED = """
import sys
import keyss.rendering.cpu.rasterization
from numba.core.dispatcher import Dispatcher
kernels = {
    f"{name}.{function}": kernel
    for name, module in list(sys.modules.items()) if name.startswith("keyss.")
    for function, kernel in vars(module).items() if isinstance(kernel, Dispatcher)
}
assert len(kernels) > 10
print(*[name for name, kernel in kernels.items() if kernel.signatures])
"""


def test_importing_compiles_nothing(tmp_path: Path) -> None:
    done = python(LIST_COMPILED, NUMBA_CACHE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == done.stderr == ""
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.slow
def test_drawing_needs_no_place_for_the_cache(tmp_path: Path) -> None:
    # Files where the folders would have to be: not even root can write below them.
    copy = tmp_path / "source"
    shutil.copytree(SOURCE / "keyss", copy / "keyss", ignore=shutil.ignore_patterns("__pycache__"))
    blocked = copy / "keyss" / "rendering" / "cpu" / "__pycache__"
    blocked.write_text("")
    places = {name: str(blocked) for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA", "HOME")}
    done = python(DRAW, copy, PYTHONDONTWRITEBYTECODE="1", **places)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compiling the CPU rasterizer") == done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_first_drawing_announces_that_it_compiles_and_the_next_one_does_not(tmp_path: Path) -> None:
    for times in (1, 0):
        done = python(DRAW, NUMBA_CACHE_DIR=str(tmp_path))
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("compiling the CPU rasterizer") == done.stderr.count("\n") == times
    assert list(tmp_path.rglob("*.nbi"))
