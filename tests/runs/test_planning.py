"""Plans of runs."""

from __future__ import annotations

import shutil
import warnings
from collections import namedtuple
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import keyss
from channels.lsb.trained_like import trained_like
from files.formats.examples import model_of
from keyss import CarryOptions, FitConfig, Secret
from keyss.core import OutputError
from keyss.files import write_model
from keyss.runs import planning
from keyss.runs.estimates import gaussians_in
from keyss.runs.folder import RunFolder
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
    assert cost.steps == (2 * 60,) * 3  # a plain fit of each scene, and the joint training
    assert len(cost.fit_seconds) == 3
    assert plan.gaussians > 2 * 400  # the payloads do not fit into low bits, and are appended
    assert plan.sh_degree == 3
    assert plan.capacity < plan.secret_gaussians == 800
    assert list(tmp_path.iterdir()) == []


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
    assert 500 < plan.capacity < 6000
    assert result.metrics.secret_gaussians[0] > 0.95 * plan.capacity  # of a lower SH degree, more fit
    assert found.cost.steps == (0, 0)


@pytest.mark.parametrize("fine_tune", ["auto", "always"])
def test_disk_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fine_tune: Any) -> None:
    """All files at the end of a run, when checkpoints and results exist."""
    sizes: list[int] = []

    def measured(folder: RunFolder) -> None:
        files = [*folder.path.rglob("*.ply"), *folder.path.rglob("*.safetensors")]
        sizes.append(sum(file.stat().st_size for file in files))
        finish(folder)

    finish = RunFolder._finish
    monkeypatch.setattr(RunFolder, "_finish", measured)
    monkeypatch.setattr(planning, "_OTHER_BYTES", 0)
    fit = replace(FIT, iterations=5, max_gaussians=200)  # as many as start
    options = CarryOptions(fit=fit, publish="converted", fine_tune=fine_tune)
    hide = partial(keyss.hide, tiny_scene(0), [Secret(tiny_scene(1), KEY)], method=options, min_psnr=0)
    cost = hide(out=tmp_path / "run", dry_run=True).cost
    hide(out=tmp_path / "run")
    keyss.fit(tiny_scene(0), config=fit, out=tmp_path / "fit")
    assert sizes[0] <= cost.disk_bytes < 2 * sizes[0]
    of_fit = planning.cost_of_fit(tiny_scene(0), fit, torch.device("cpu"))
    assert sizes[1] <= of_fit.disk_bytes < 2 * sizes[1]


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []

    def usage(path: Path) -> Usage:
        asked.append(Path(path))
        return Usage(10**9, 10**9, 1 << 20)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    write_model(tmp_path / "cover.ply", trained_like(2500))
    secrets = [Secret(trained_like(900, 1), KEY)]
    for verb in (keyss.hide, partial(keyss.hide, dry_run=True)):
        with pytest.raises(OutputError, match=r"free space.*found 1 MB"):
            verb(tmp_path / "cover.ply", secrets, method="carry", out=tmp_path / "a" / "run")
    assert set(asked) == {tmp_path.resolve()}
    assert [path.name for path in tmp_path.iterdir()] == ["cover.ply"]


def test_estimated_model_sizes(tmp_path: Path) -> None:
    (tmp_path / "point_cloud/iteration_7").mkdir(parents=True)
    inside = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    write_model(inside, model_of(3000, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the command warns of the chosen model, once
        assert gaussians_in(tmp_path) == gaussians_in(inside) == 3000
    for name in ("a.spz", "a.compressed.ply", "a.sog"):
        write_model(tmp_path / name, model_of(20_000, 0))
        assert 10_000 < gaussians_in(tmp_path / name) < 40_000
    for name in ("-", "missing.ply", "a/b"):
        assert gaussians_in(Path(name)) == 0
