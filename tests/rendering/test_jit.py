"""The cache of compiled kernels: its folder, rendering without one, and imports that compile nothing."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numba
import numpy as np
import pytest

from keyss.rendering.cpu import blending, jit
from rendering.child_process import SOURCE, python


def add_one(x: float) -> float:
    return x + 1.0


def test_kernels_are_cached_in_the_folder_of_these_sources() -> None:
    folder = jit.cache_folder()
    assert folder is not None
    assert Path(blending.blend.stats.cache_path).is_relative_to(folder)


SOURCES = sorted(Path(jit.__file__).parent.glob("*.py"))


@pytest.mark.parametrize("name", [path.name for path in SOURCES])
def test_a_change_of_any_source_makes_a_new_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in SOURCES:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "jit.py"))
    monkeypatch.setattr(jit, "_cache_parents", lambda: [tmp_path / "cache"])
    find = jit.cache_folder.__wrapped__
    folders = [find(), find()]
    with (tmp_path / name).open("a") as file:
        file.write("# changed\n")
    folders.append(find())
    (tmp_path / name).rename(tmp_path / "renamed.py")
    folders.append(find())
    assert len(set(folders[:2])) == 1
    assert len(set(folders)) == 3


def test_an_unwritable_place_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder can be made in here")
    places = [tmp_path / "file" / "cache", tmp_path / "cache"]
    monkeypatch.setattr(jit, "_cache_parents", lambda: places)
    folder = jit.cache_folder.__wrapped__()
    assert folder is not None
    assert folder.parent == tmp_path / "cache"
    places.pop()
    assert jit.cache_folder.__wrapped__() is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have no owners and modes here")
def test_a_place_that_others_can_change_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find, place = jit.cache_folder.__wrapped__, tmp_path / "shared"
    place.mkdir()
    monkeypatch.setattr(jit, "_cache_parents", lambda: [place / "cache"])
    for mode, is_safe in ((0o700, True), (0o777, False), (0o775, False), (0o1777, True)):
        place.chmod(mode)
        assert (find() is not None) == is_safe, oct(mode)
    folder = find()
    assert folder is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert find() is None
    folder.chmod(0o700)
    another = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: another)  # the folder was made by somebody else
    assert find() is None


def test_kernels_compile_without_any_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "cache_folder", lambda: None)
    compiled = jit.kernel(add_one)
    assert compiled(np.float32(1)) == 2
    assert compiled.stats.cache_path is None


def test_a_cache_folder_that_goes_away_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(jit, "cache_folder", lambda: folder)
    compiled = jit.kernel(add_one)
    shutil.rmtree(folder)
    assert compiled(np.float32(1)) == 2
    assert list(folder.rglob("*.nbi"))


def test_the_users_cache_setting_is_respected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert jit._cache_parents()[0] == tmp_path
    monkeypatch.setattr(jit, "cache_folder", jit.cache_folder.__wrapped__)
    compiled = jit.kernel(add_one)
    assert str(tmp_path) == numba.config.CACHE_DIR
    assert compiled(np.float32(1)) == 2
    assert list(tmp_path.rglob("*.nbi"))


def test_the_first_compilation_is_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    jit.announce_compilation.__wrapped__()
    message = capsys.readouterr().err
    assert "compiling the CPU rasterizer" in message
    assert message.count("\n") == 1
    (tmp_path / "low_bits_1f").mkdir()
    (tmp_path / "low_bits_1f" / "kernel.nbi").write_text("")  # of something else than the rasterizer
    jit.announce_compilation.__wrapped__()
    assert "compiling the CPU rasterizer" in capsys.readouterr().err
    (tmp_path / "cpu_1f").mkdir()
    (tmp_path / "cpu_1f" / "kernel.nbi").write_text("")
    jit.announce_compilation.__wrapped__()
    assert capsys.readouterr().err == ""


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
