"""The cache of compiled kernels: its folder, and rendering without one."""

from __future__ import annotations

import shutil
from pathlib import Path

import numba
import numpy as np
import pytest

from keyss.rendering.cpu import blending, jit


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
