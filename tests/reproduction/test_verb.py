"""A table from photos to claims, at a size where it takes seconds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cli.conftest import keyss as keyss
from cli.said import Said, listing
from keyss import FitConfig
from keyss._verbs import reproducing
from keyss.api import PaperTable, plan_reproduction, reproduce
from keyss.core import InputError, OutputError
from keyss.core.gaussians import Gaussians
from keyss.reproduction import asking
from keyss.reproduction.asking import setting_of
from keyss.reproduction.measuring import _own, _sparing
from test_api import write_nerfstudio
from tiny_scenes import random_gaussians, tiny_scene

SIZES = {"iterations": 20, "max_gaussians": 150}
FLAGS = ("--iterations", 20, "--max-gaussians", 150, "--most", 1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("scenes")
    return [write_nerfstudio(root / name, tiny_scene(index)) for index, name in enumerate("ab")]


@pytest.fixture(scope="module")
def out(folders: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the table "pruning", which others use the run of."""
    folder = tmp_path_factory.mktemp("tables") / "paper"
    with pytest.warns(UserWarning, match="too small to carry"):
        reproduce(PaperTable("pruning", folders, most=1, **SIZES), seed=5, out=folder)
    return folder


def test_a_table_lies_beside_the_papers(out: Path) -> None:
    found = json.loads((out / "pruning.json").read_text())
    assert found["pairs"] == ["a-b"]
    (row,) = found["rows"]
    here = {each["measure"]: each["here"] for each in row["figures"]}
    numbers = json.loads((out / "runs" / "a-b" / "keyss.quality.json").read_text())["numbers"]
    assert here["whole, cover"] == pytest.approx(numbers["cover"], abs=0.05)
    assert here["whole, secret"] == pytest.approx(numbers["secret"], abs=0.05)
    assert None not in here.values()
    metrics = json.loads((out / "runs" / "a-b" / "keyss" / "private" / "metrics.json").read_text())
    assert metrics["iterations"] == 20
    assert metrics["steps"] == [20, 20]  # as many as plain 3DGS
    assert metrics["baseline"]["equal"] == [True, True]
    assert {each["verdict"] for each in found["claims"]} <= {"holds", "holds in part", "does not hold here"}
    assert "| whole, cover | 25.98 |" in (out / "pruning.md").read_text()
    assert (out / "key-1.txt").stat().st_mode & 0o77 == 0


def test_what_is_done_is_not_done_again(
    out: Path, folders: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = listing(out / "runs") | listing(out / "plain")

    def refused(*arguments: object, **more: object) -> None:
        raise AssertionError("nothing is to be run")

    monkeypatch.setattr(reproducing, "hide", refused)
    monkeypatch.setattr(reproducing, "fitted_once", refused)
    again = reproduce(PaperTable("pruning", folders, most=1, **SIZES), out=out)
    assert not again.failures
    assert listing(out / "runs") | listing(out / "plain") == before
    assert all(
        run.done for run in plan_reproduction(PaperTable("pruning", folders, most=1, **SIZES), out=out)
    )


def test_a_run_that_fails_is_said_and_the_others_go_on(
    out: Path, folders: list[Path], monkeypatch: pytest.MonkeyPatch, keyss: Callable[..., Said]
) -> None:
    def failing(*arguments: object, **more: object) -> None:
        raise InputError("not today")

    monkeypatch.setattr(reproducing, "hide", failing)
    found = reproduce(PaperTable("speed", folders, most=1, **SIZES), out=out)
    assert found.failures == {f"{name}, a-b": "not today" for name in ("3dgs", "gs-hider", "watergs")}
    verdicts = [each.verdict for each in found.claims]
    assert verdicts[0] in ("holds", "holds in part", "does not hold here")  # the run of before
    assert verdicts[1] == "not measured"
    said = keyss("reproduce", "speed", *folders, *FLAGS, "-o", out)
    assert (said.status, said.err.strip()) == (4, "keyss: error: 3 run(s) failed")
    assert "not today" in said.out


def test_other_sizes_scenes_and_seeds_need_another_folder(
    out: Path, folders: list[Path], tmp_path: Path
) -> None:
    elsewhere = write_nerfstudio(tmp_path / "a", tiny_scene(2))
    same = PaperTable("pruning", folders, most=1, **SIZES)
    for asked, seed in (
        (replace(same, iterations=30), None),
        (same, 6),
        (replace(same, scenes=[elsewhere, folders[1]]), None),
    ):
        with pytest.raises(OutputError, match="another folder"):
            reproduce(asked, seed=seed, out=out)


def test_the_command(keyss: Callable[..., Said], out: Path, folders: list[Path], tmp_path: Path) -> None:
    said = keyss("reproduce", "pruning", *folders, *FLAGS, "-o", out)
    assert said.status == 0, said.err
    assert "25% random, secret" in said.out
    assert "Random loss of a quarter" in said.out
    planned = keyss("reproduce", "sinkhorn", *folders, *FLAGS, "--dry-run", "-o", tmp_path / "new")
    assert planned.status == 0, planned.err
    assert not (tmp_path / "new").exists()
    lines = planned.out.splitlines()
    assert [line.split(",")[0] for line in lines[1:6]] == [
        *("plain model", "plain model", "keyss-op", "keyss-op-ro", "keyss"),
    ]
    assert "5 to do" in planned.out
    assert keyss("reproduce", "single", folders[0], "-o", tmp_path / "new").status == 2
    said = keyss("reproduce", "single", *folders, "--width", 0, "-o", tmp_path / "new")
    assert (said.status, "--width" in said.err) == (2, True), said
    full = keyss("reproduce", "multi", "--scale", "full", "--data", tmp_path, "-o", tmp_path / "new")
    assert (full.status, "Mip-NeRF 360" in full.err) == (4, True)


def test_full_scale_has_the_papers_sizes_and_pairs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(asking, "check_benchmark", lambda data, name: None)
    asked = setting_of(PaperTable("multi", scale="full", data=tmp_path), tmp_path / "out")
    assert asked.groups[1] == ("bicycle", "bonsai", "room")
    fit: FitConfig = asked.options(asked.table.cells[0], 1).fit
    assert (fit.iterations, fit.max_gaussians, fit.ssim_weight) == (30_000, 500_000, 0.5)
    assert asked.fit.iterations == 30_000
    one = setting_of(PaperTable("single", scale="full", data=tmp_path, most=2), tmp_path / "out")
    assert one.groups == (("bicycle", "playroom"), ("bonsai", "counter"))


def test_what_is_appended_is_neither_counted_nor_pruned(out: Path) -> None:
    from keyss import read_model
    from keyss.measure.robustness.changes import opacity_pruning, random_pruning

    stego = read_model(out / "runs" / "a-b" / "keyss" / "publish" / "stego.ply")
    own = _own(stego)
    assert 0 < len(own) <= 150 < len(stego)
    for change in (random_pruning(0.25), opacity_pruning(0.25)):
        left = _sparing(change)(stego)
        assert len(_own(left)) == len(change(own))
        assert len(left) - len(_own(left)) == len(stego) - len(own)
        assert torch.equal(_own(left).means, change(own).means)
    plain: Gaussians = random_gaussians(100)
    assert torch.equal(_own(plain).means, plain.means)
