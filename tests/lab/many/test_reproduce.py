"""A table from photos to claims, at a tiny size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cli.harness import Run, listing
from keyss import reproduce
from keyss.core import InputError
from keyss.lab.audits import trial_measures
from keyss.lab.many import Forecast, Reproduction, trial

SIZES = {"iterations": 20, "max_gaussians": 150}
FLAGS = ("--iterations", 20, "--max-gaussians", 150, "--pairs", "a,b", "--seed", 5)


@pytest.fixture(scope="module")
def out(folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the table "pruning", whose run other tables share."""
    folder = tmp_path_factory.mktemp("tables") / "paper"
    with pytest.MonkeyPatch.context() as patch:  # opening what was pruned takes long
        patch.setattr(trial_measures, "PRUNED_SHARES", (0.25,))
        with pytest.warns(UserWarning, match="secrets lie in appended Gaussians"):
            run("pruning", folders, folder)
    return folder


def run(table: str, folders: tuple[Path, Path], out: Path, **options: Any) -> Reproduction:
    found = reproduce(table, folders, pairs=["a,b"], seeds=[5], out=out, **SIZES, **options)
    assert isinstance(found, Reproduction)
    return found


def run_of(trial: str, out: Path) -> Path:
    """The folder of the results of a trial by its name."""
    records = out.glob("trials/*/trial.json")
    (path,) = (path for path in records if json.loads(path.read_text())["name"] == trial)
    return path.parent / "run"


def test_table(out: Path) -> None:
    found = json.loads((out / "pruning.json").read_text())
    assert found["pairs"] == ["a-b"]
    (row,) = found["rows"]
    here = row["here"]
    metrics = json.loads((run_of("KeySS, a-b", out) / "private" / "metrics.json").read_text())
    assert here["whole, cover"] == pytest.approx(metrics["cover"]["psnr"], abs=0.05)
    assert here["whole, secret"] == pytest.approx(metrics["secrets"][0]["psnr"], abs=0.05)
    assert {name for name, value in here.items() if value is not None} == {
        f"{what}, {role}"
        for what in ("whole", "25% by opacity", "25% random")
        for role in ("cover", "secret")
    }
    assert metrics["iterations"] == 20
    assert metrics["steps"] == [20, 20]  # as many as plain 3DGS
    assert metrics["baseline"]["equal"] == [True, True]
    assert {each["verdict"] for each in found["claims"]} <= {"holds", "holds in part", "does not hold here"}


def test_resume(out: Path, folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    before = listing(out / "trials")

    def refused(*arguments: object, **more: object) -> None:
        raise AssertionError("nothing is to be run")

    monkeypatch.setattr(trial, "hide", refused)
    monkeypatch.setattr(trial, "fit", refused)
    assert not run("pruning", folders, out).failures
    assert listing(out / "trials") == before
    found = reproduce("pruning", folders, pairs=["a,b"], seeds=[5], out=out, **SIZES, dry_run=True)  # type: ignore[arg-type]
    assert isinstance(found, Forecast)
    assert not found.costs
    monkeypatch.undo()
    other = reproduce("pruning", folders, pairs=["a,b"], seeds=[6], out=out, **SIZES, dry_run=True)  # type: ignore[arg-type]
    assert isinstance(other, Forecast)
    assert len(other.costs) == len(other.names)


def test_failed_trials(
    out: Path, folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, keyss: Run
) -> None:
    def failing(*arguments: object, **more: object) -> None:
        raise InputError("not today")

    monkeypatch.setattr(trial, "hide", failing)
    found = run("speed", folders, out)
    assert found.failures == {f"{name}, a-b": "not today" for name in ("3DGS", "GS-Hider", "WaterGS")}
    verdicts = [claim.verdict for claim in found.claims]
    assert verdicts[0] in ("holds", "holds in part", "does not hold here")  # from the first run
    assert verdicts[1] == "not measured"
    said = keyss("reproduce", "speed", *folders, *FLAGS, "-o", out)
    assert (said.status, said.err.splitlines()[-1]) == (4, "keyss: error: 3 run(s) failed")
    assert "not today" in said.out


def test_command(keyss: Run, out: Path, folders: tuple[Path, Path], tmp_path: Path) -> None:
    said = keyss("reproduce", "pruning", *folders, *FLAGS, "-o", out)
    assert said.status == 0, said.err
    assert "25% random, secret" in said.out
    assert "Random loss of a quarter" in said.out
    planned = keyss("reproduce", "sinkhorn", *folders, *FLAGS, "--dry-run", "-o", tmp_path / "new")
    assert planned.status == 0, planned.err
    assert not (tmp_path / "new").exists()
    assert [line.split("  ")[0] for line in planned.out.splitlines()[1:6]] == [
        *(f"plain model of {scene}, 20 steps, 150 Gaussians" for scene in "ab"),
        *(f"{mask}, a-b" for mask in ("op", "op,ro", "op,ro,sc,xyz")),
    ]
    assert "5 to do" in planned.out
    assert keyss("reproduce", "single", folders[0], "-o", tmp_path / "new").status == 2
    said = keyss("reproduce", "single", *folders, "--width", 0, "-o", tmp_path / "new")
    assert (said.status, "--width" in said.err) == (2, True), said
    full = keyss("reproduce", "multi", *folders, "--full", "-o", tmp_path / "new")
    assert (full.status, "expected a scene called 'flowers', got a, b" in full.err) == (2, True)
