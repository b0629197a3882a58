"""Typical first uses."""

from __future__ import annotations

from pathlib import Path

import pytest

import keyss as library
from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, Run, scene_arguments, write_key
from keyss.files import write_model

KEY = "q7Rv2LxT9bWm4KzD"
HIDE = ("hide", "--cover", "cover.ply", "--key-file", "key.txt", "--width", "16", "--device", "cpu")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, count, degree in (("cover", 1500, 3), ("flat", 1500, 0), ("small", 200, 2), ("large", 2500, 3)):
        write_model(tmp_path / f"{name}.ply", trained_like(count, count).with_sh_degree(degree))
    write_key(tmp_path / "key.txt", KEY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_key_sources_are_equivalent(keyss: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    text = Path("key.txt").read_text()
    assert text.endswith("\n")
    library.hide("cover.ply", [library.Secret("small.ply", text)], views=library.ViewOptions(16), out="run")
    assert keyss("reveal", "run/publish/model.ply", "--key-file", "key.txt", "-o", "out.ply").status == 0
    assert library.reveal("run/publish/model.ply", library.read_key("key.txt")).gaussians.sh_degree == 2
    for key, status in ((f"{KEY} ", 0), (f"{KEY}x", 3)):
        monkeypatch.setenv("KEYSS_KEY", key)
        result = keyss("verify", "run/publish/model.ply")
        assert result.status == status
        assert ("white space around the key does not count" in result.err) == key.endswith(" ")


def test_hide_from_few_photos(keyss: Run, workspace: Path) -> None:
    few = [word if word != "100" else "1200" for word in SMALL]
    result = keyss("hide", *scene_arguments(workspace), *few, "--fine-tune", "always", "-o", "run")
    assert result.status == 0, result.err
    assert "fine-tuning of the secret" in result.err
    assert keyss("verify", "run/publish/model.ply", "--key-file", "key.txt").status == 0
