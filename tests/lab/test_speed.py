"""Times, sizes and third-party readers, with a known clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import plyfile
import pytest
import torch

from channels.quiet.trained_like import trained_like
from keyss.core import Gaussians, Scene
from keyss.files import write_model
from keyss.lab import ReaderResult, measure_speed, readers, render_time, reveal_seconds, speed as module
from keyss.methods import Opened, open_model
from lab.opened import Whole
from methods.carry.carried import embed
from tiny_scenes import random_gaussians, tiny_scene

KEY = "the right key"


class Clock:
    """Time that passes only where a test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def pass_(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_the_ratio_is_that_of_the_times_whatever_else_the_machine_does(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture takes a millisecond per Gaussian; the machine slows down, and everything is slow at first."""
    drawn: list[int] = []

    def render(model: Gaussians, *_: Any) -> torch.Tensor:
        drawn.append(len(model))
        clock.pass_(len(model) / 1000 * (50 if len(drawn) <= 4 else 1 + (len(drawn) - 1) // 8))
        return torch.zeros(1)

    monkeypatch.setattr(module, "render", render)
    found = render_time(random_gaussians(30), random_gaussians(20), tiny_scene(), views=2, rounds=6)
    assert found.ratio == pytest.approx(1.5, rel=1e-6)
    assert len(drawn) == 2 * 2 * 7
    assert found.seconds < 30 * 6 / 1000
    # Neither of both always comes first.
    assert {tuple(drawn[i : i + 2]) for i in range(0, len(drawn), 2)} == {(30, 20), (20, 30)}


def test_a_model_takes_longer_than_a_hundredth_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Really drawn, in time of this process, which others do not take."""
    monkeypatch.setattr(time, "perf_counter", time.process_time)
    scene, model = tiny_scene(), random_gaussians(3000)
    found = render_time(model, model[:30], scene)
    assert found.ratio > 1
    assert found.seconds > 0


def test_revealing_is_timed_from_file_to_file(clock: Clock, tmp_path: Path) -> None:
    write_model(tmp_path / "in.ply", random_gaussians(10))
    waits = iter([5.0, 1.0, 2.0])

    def opener(model: Gaussians) -> Whole:
        clock.pass_(next(waits))
        return Whole(model[:4])

    file, seconds = reveal_seconds(tmp_path / "in.ply", opener, tmp_path / "out")
    assert (file, seconds) == (tmp_path / "out.ply", pytest.approx(2.0))
    assert plyfile.PlyData.read(file)["vertex"].count == 4


# --- readers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_other_peoples_readers_find_our_values(degree: int, tmp_path: Path) -> None:
    write_model(tmp_path / "a.ply", random_gaussians(40, sh_degree=degree))
    found = {each.reader: each for each in readers(tmp_path / "a.ply")}
    for name in ("plyfile", "gsply"):
        assert found[name] == ReaderResult(name, True, 40)


def test_what_has_no_exact_numbers_is_not_held_against_other_readers(tmp_path: Path) -> None:
    for name in ("a.spz", "a.compressed.ply"):
        write_model(tmp_path / name, random_gaussians(40))
        assert {(each.loads, "only a .ply" in str(each.note)) for each in readers(tmp_path / name)} == {
            (None, True)
        }


def test_splat_transform_finds_our_values(tmp_path: Path, splat_transform: Callable[..., Path]) -> None:
    write_model(tmp_path / "a.ply", random_gaussians(40))
    assert readers(tmp_path / "a.ply")[2] == ReaderResult("splat-transform", True, 40)


def test_other_values_fewer_values_and_failures_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = random_gaussians(40)
    write_model(tmp_path / "a.ply", model)

    def copying(change: Callable[[Gaussians], Gaussians]) -> Callable[[Path, Path], Path]:
        def copy(source: Path, target: Path) -> Path:
            write_model(target, change(model))
            return target

        return copy

    def failing(source: Path, target: Path) -> Path:
        raise ValueError("no such format")

    monkeypatch.setattr(module, "_plyfile", copying(lambda m: m[:39]))
    monkeypatch.setattr(module, "_gsply", copying(lambda m: m.map(lambda values: values * (1 + 1e-6))))
    monkeypatch.setattr(module, "transform", failing)
    assert readers(tmp_path / "a.ply") == [
        ReaderResult("plyfile", False, 39),
        ReaderResult("gsply", False, 40),
        ReaderResult("splat-transform", False, note="no such format"),
    ]


def test_readers_that_are_absent_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr("keyss.lab.robustness.survival.import_module", missing)
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tmp_path / "nowhere"))
    write_model(tmp_path / "a.ply", random_gaussians(4))
    found = readers(tmp_path / "a.ply")
    assert [each.loads for each in found] == [None] * 3
    assert all("not installed (" in (each.note or "") for each in found)


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
