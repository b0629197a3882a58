"""Times, sizes and third-party readers, with a known clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from channels.quiet.trained_like import trained_like
from keyss.core import Gaussians, Scene
from keyss.files import write_model
from keyss.lab import ReaderResult, measure_speed, readers
from keyss.methods import Opened, open_model
from methods.carry.carried import embed
from tiny_scenes import random_gaussians, tiny_scene

KEY = "the right key"


# --- readers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_other_peoples_readers_find_our_values(degree: int, tmp_path: Path) -> None:
    write_model(tmp_path / "a.ply", random_gaussians(40, sh_degree=degree))
    found = {each.reader: each for each in readers(tmp_path / "a.ply")}
    for name in ("plyfile", "gsply"):
        assert found[name] == ReaderResult(name, True, 40)


def test_splat_transform_finds_our_values(tmp_path: Path, splat_transform: Callable[..., Path]) -> None:
    write_model(tmp_path / "a.ply", random_gaussians(40))
    assert readers(tmp_path / "a.ply")[2] == ReaderResult("splat-transform", True, 40)


# --- all of it -------------------------------------------------------------------------------------------


def test_speed_of_a_carried_secret(tmp_path: Path) -> None:
    scenes: list[Scene] = [tiny_scene(0, views=8), tiny_scene(1, views=8)]
    cover, secret = trained_like(1000), trained_like(300, seed=1)
    write_model(tmp_path / "stego.ply", embed(cover, [(KEY, secret)]))
    steps: list[tuple[int, int]] = []

    def slowly(model: Gaussians) -> Opened:
        time.sleep(0.05)
        return open_model(model, KEY)

    found = measure_speed(
        tmp_path / "stego.ply",
        [slowly],
        scenes,
        [cover, secret],
        rounds=2,
        progress=lambda *step: steps.append(step),
    )
    write_model(tmp_path / "secret.ply", secret)  # the same size as the revealed file
    assert found.bytes == {
        "stego": (tmp_path / "stego.ply").stat().st_size,
        "secret 1": (tmp_path / "secret.ply").stat().st_size,
    }
    assert list(found.render) == ["stego", "secret 1"]
    assert len(found.reveal_seconds) == 1
    assert 0.05 <= found.reveal_seconds[0] < 60
    assert steps == [(0, 2), (1, 2)]
