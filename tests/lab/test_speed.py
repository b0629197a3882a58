"""Times and sizes, with a known delay."""

from __future__ import annotations

import time
from pathlib import Path

from channels.quiet.trained_like import trained_like
from keyss.core import Gaussians, Scene
from keyss.files import write_model
from keyss.lab import measure_speed
from keyss.methods import Opened, open_model
from methods.carry.carried import embed
from tiny_scenes import tiny_scene

KEY = "the right key"


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
