"""What somebody tries in the first hour, and what the command line answers."""

from __future__ import annotations

from pathlib import Path

import pytest

import keyss as library
from channels.quiet.trained_like import trained_like
from cli.said import SMALL, Run, write_key
from keyss.files import write_model

KEY = "q7Rv2LxT9bWm4KzD"
HIDE = ("hide", "--cover", "cover.ply", "--key-file", "key.txt", "--width", "16", "--device", "cpu")


@pytest.fixture(autouse=True)
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, count, degree in (("cover", 1500, 3), ("flat", 1500, 0), ("small", 200, 2), ("large", 2500, 3)):
        write_model(tmp_path / f"{name}.ply", trained_like(count, count).with_sh_degree(degree))
    write_key(tmp_path / "key.txt", KEY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_one_key_in_python_in_a_file_and_in_the_environment(
    keyss: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = Path("key.txt").read_text()
    assert text.endswith("\n")
    library.hide("cover.ply", [library.Secret("small.ply", text)], out="run")
    assert keyss("reveal", "run/publish/model.ply", "--key-file", "key.txt", "-o", "out.ply").status == 0
    assert library.reveal("run/publish/model.ply", library.read_key("key.txt")).gaussians.sh_degree == 2
    for key, status in ((f"{KEY} ", 0), (f"{KEY}x", 3)):
        monkeypatch.setenv("KEYSS_KEY", key)
        said = keyss("verify", "run/publish/model.ply")
        assert said.status == status
        assert ("white space around the key does not count" in said.err) == key.endswith(" ")


def test_a_cover_without_harmonics_gets_the_room_that_the_refusal_promises(keyss: Run) -> None:
    flat = [word.replace("cover.ply", "flat.ply") for word in HIDE]
    shown = keyss(*flat, "--secret", "small.ply", "-o", "shown")
    assert shown.status == 0, shown.err
    assert "whoever inspects the published file sees that it holds something" in shown.err.splitlines()[0]
    refused = keyss(*flat, "--secret", "small.ply", "--format", "ply", "-o", "run")
    assert refused.status == 2
    assert "--sh-degree 1 makes room" in refused.err
    done = keyss(*flat, "--secret", "small.ply", "--sh-degree", "1", "--iterations", "5", "-o", "run")
    assert done.status == 0, done.err
    assert "The secret kept 200 of 200 Gaussians" in done.out


def test_short_fits_of_two_photos_end_in_models_that_carry(keyss: Run, world: Path) -> None:
    few = [word if word != "100" else "1200" for word in SMALL]
    scenes = ("--cover", world / "a", "--secret", world / "b", "--key-file", "key.txt")
    said = keyss("hide", *scenes, *few, "-o", "run")
    assert said.status == 0, said.err
    assert "refit of the secret" in said.err  # the cover got half as many Gaussians
    assert "The secret kept" in said.out
    assert keyss("verify", "run/publish/model.ply", "--key-file", "key.txt").status == 0
