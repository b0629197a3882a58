"""Plans of runs."""

from __future__ import annotations

import shutil
from collections import namedtuple
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import keyss
from channels.lsb.trained_like import trained_like
from keyss import CarryOptions, FitConfig, Secret
from keyss.core import OutputError
from keyss.files import write_model
from keyss.methods import registry
from methods.keyss.small import small
from tiny_scenes import tiny_scene

KEY = "a key of many characters: 93hXmQ2"
FIT = FitConfig(iterations=60, max_gaussians=400, evaluate_every=0, seed=0)
Usage = namedtuple("Usage", "total used free")


@pytest.mark.filterwarnings("ignore:.*appended Gaussians")
def test_sizes_and_steps(tmp_path: Path) -> None:
    secrets = [Secret(tiny_scene(1), KEY), Secret(tiny_scene(2), KEY + "2")]
    options = small("published", FIT)
    found = keyss.hide(tiny_scene(0), secrets, method=options, out=tmp_path / "run", dry_run=True)
    plan, cost = found.plan, found.cost
    assert cost.steps == 4 * 60  # three plain fits, and the joint training
    assert len(cost.fit_seconds) == 3
    assert plan.gaussians > 2 * 400  # the payloads do not fit into low bits, and are appended
    assert plan.sh_degree == 3
    assert plan.capacity < plan.secret_gaussians == 800
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore:.*appended Gaussians")
def test_steps_with_networks_take_longer() -> None:
    seconds = []
    fit = replace(FIT, iterations=1_000_000)
    hider = registry.get("gs-hider").options(fit=fit)
    second = registry.get("3dgs-sh").options(fit=fit)
    for options, key in ((second, ""), (small("published", fit), KEY), (hider, "")):
        cost = keyss.hide(tiny_scene(0), [Secret(tiny_scene(1), key)], method=options, dry_run=True).cost
        seconds.append(cost.seconds - sum(cost.fit_seconds))
    harmonics, published, networks = seconds
    assert 2 * harmonics < published < networks


def test_bound_takes_longer() -> None:
    secret, seconds = Secret(tiny_scene(1), KEY), []
    options = CarryOptions(fit=FIT, iterations=90, publish="converted", fine_tune="always")
    for bound in (False, True):
        cost = keyss.hide(tiny_scene(0), [secret], method=options, bound=bound, dry_run=True).cost
        seconds.append(cost.seconds)
    # Of the secret: 60 steps of its plain model, and 90 of fine-tuning.
    assert seconds[1] - seconds[0] == pytest.approx(cost.fit_seconds[1] * 150 / 60)


def test_capacity(tmp_path: Path) -> None:
    cover, secret = trained_like(2500), trained_like(6000, 2)
    options = CarryOptions(fine_tune="never")
    found = keyss.hide(
        cover, [Secret(secret, KEY)], method=options, views=keyss.ViewOptions(24), dry_run=True
    )
    plan = found.plan
    result = keyss.hide(cover, [Secret(secret, KEY)], method=options, views=keyss.ViewOptions(24), min_psnr=0)
    assert plan.secret_gaussians == 6000
    # Fewer harmonics make room for more Gaussians than planned.
    assert 1000 < plan.capacity <= result.metrics.secret_gaussians[0] < 6000
    assert found.cost.steps == 0


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []

    def usage(path: Path) -> Usage:
        asked.append(Path(path))
        return Usage(10**9, 10**9, 4 << 20)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    write_model(tmp_path / "cover.ply", trained_like(2500))
    secrets = [Secret(trained_like(900, 1), KEY)]
    for verb in (keyss.hide, partial(keyss.hide, dry_run=True)):
        with pytest.raises(OutputError, match=r"free space.*found 4 MB"):
            verb(tmp_path / "cover.ply", secrets, method="carry", out=tmp_path / "a" / "run")
    assert set(asked) == {tmp_path.resolve()}
    assert [path.name for path in tmp_path.iterdir()] == ["cover.ply"]
