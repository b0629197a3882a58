"""Sweeps: specifications, trials, tables."""

from __future__ import annotations

import csv
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.harness import Run
from keyss.core import BackendError, InputError
from keyss.files import write_bytes
from keyss.lab.many import Forecast, Outcome, sweep, trial, trial_folder
from keyss.progress import Reporter
from keyss.runs import record_bytes
from tiny_scenes import random_gaussians

GOOD = """
pairs:
  - {cover: a.ply, secrets: [b.ply]}
methods:
  - {method: carry, preset: quick, grid: {fit.sh_degree: [1, 3], fit.iterations: [10, 20]}}
"""


def fake_run(job: trial.Trial, folder: Path, reporter: Reporter) -> trial.Result:
    """Numbers that depend on the seed; covers with "broken" or "odd" in their names fail."""
    if "broken" in Path(job.cover).name:
        raise InputError(f"{job.cover}: nothing of it can be read")
    if "odd" in Path(job.cover).name:
        raise RuntimeError("out of memory")
    seed = getattr(job.options, "fit", job.options).known_seed
    folder.mkdir(parents=True)
    numbers = {"cover.psnr": 30.0 + seed, "cover.ssim": 0.9, "secrets.1.psnr": 20.0, "seconds": 1.0}
    result = trial.Result(seconds=0.1, numbers=numbers)
    write_bytes(folder / "result.json", record_bytes(result))
    return result


@pytest.fixture
def _fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial_folder, "run_trial", fake_run)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(name)
    return tmp_path


def run(*arguments: Any, **options: Any) -> tuple[Outcome, ...]:
    """Run a sweep."""
    found = sweep(*arguments, **options)
    assert isinstance(found, tuple)
    return found


def spec_of(folder: Path, text: str) -> Path:
    path = folder / "spec.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pairs:", "piars:", "unknown field `piars`"),
        ("cover: a.ply", "covr: a.ply", "unknown field `covr`"),
        ("cover: a.ply", "cover: c.ply", "pairs[0].cover: there is no c.ply"),
        ("cover: a.ply", "cover: 7", "Expected `str`, got `int`"),
        ("fit.sh_degree:", "fit.sh_degre:", "did you mean fit.sh_degree"),
        ("fit.iterations:", "fit.iteration:", "did you mean fit.iterations"),
        ("[1, 3]", "[1, many]", "Expected `int`, got `str`"),
        ("[10, 20]", "[10, 0]", "expected 1 to 10000000, got 0"),
        ("[1, 3]", "[]", "length >= 1 - at `$.methods[0].grid[...]`"),
        ("method: carry", "method: carrry", "Invalid enum value 'carrry'"),
        ("preset: quick", "preset: quik", "Invalid enum value 'quik'"),
        ("secrets: [b.ply]", "secrets: []", "length >= 1 - at `$.pairs[0].secrets`"),
        ("methods:", "seeds: [1, 1]\nmethods:", "two are called 1"),
        ("methods:", "evaluate: [stelth]\nmethods:", "Invalid enum value 'stelth'"),
        ("methods:", "width: !!python/object/apply:os.system [ls]\nmethods:", "expected YAML"),
        ("{cover", "{{{cover", "expected YAML"),
        (
            "methods:",
            "  - {cover: b.ply, secrets: [a.ply], name: a-b}\nmethods:",
            "pairs: two are called 'a-b'",
        ),
        ("methods:", "methods:\n  - {method: carry, preset: default}", "methods: two are called 'carry'"),
    ],
)
def test_invalid_specifications(files: Path, old: str, new: str, words: str) -> None:
    assert old in GOOD
    path = spec_of(files, GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        run(path, files / "out")
    assert words in str(caught.value)
    assert not (files / "out").exists()


def write_spec(folder: Path, covers: list[str], seeds: int, more: str = "") -> Path:
    """A specification, and files for it that are no models."""
    for name in (*covers, "secret.ply"):
        if not (folder / name).exists():
            (folder / name).write_text(name)
    pairs = "\n".join(f"  - {{cover: {name}, secrets: [secret.ply]}}" for name in covers)
    text = f"pairs:\n{pairs}\nmethods:\n  - {{method: carry, options: {{publish: converted}}}}\n"
    return spec_of(folder, f"{text}seeds: {list(range(seeds))}\n{more}")


def real_spec(folder: Path, seeds: int) -> Path:
    """A specification with tiny models."""
    library.write_model(folder / "a.ply", random_gaussians(300, seed=0))
    library.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    return write_spec(folder, ["a.ply"], seeds, "width: 32\n")


def skipped(found: tuple[Outcome, ...]) -> list[bool]:
    return [each.skipped for each in found]


@pytest.mark.usefixtures("_fake_runs")
def test_trials_run_once(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply", "b.ply"], seeds=3)
    first = run(spec, tmp_path / "out")
    assert skipped(first) == [False] * 6
    assert skipped(run(spec, tmp_path / "out")) == [True] * 6
    run(spec, tmp_path / "other")
    for name in ("results.csv", "trials.csv", "scenes.csv", "scenes.tex"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
    with (tmp_path / "out" / "results.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["measure"] == "cover.psnr"]
    # Numbers of the fake are 30, 31 and 32.
    assert [(row["pair"], row["seeds"], row["mean"], row["std"]) for row in rows] == [
        ("a-secret", "3", "31.0", "1.0"),
        ("b-secret", "3", "31.0", "1.0"),
    ]
    with (tmp_path / "out" / "scenes.csv").open() as file:
        scenes = list(csv.DictReader(file))
    assert [
        (row["scene"], row["role"], row["psnr"], row["psnr_std"], row["lpips"]) for row in scenes[:2]
    ] == [("a", "cover", "31.0", "1.0", ""), ("secret", "secret", "20.0", "0.0", "")]
    assert "seconds" not in (tmp_path / "out" / "trials.csv").read_text()  # they differ from run to run


@pytest.mark.usefixtures("_fake_runs")
def test_changed_files_and_options(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=2)
    out = tmp_path / "out"
    assert skipped(run(spec, out)) == [False, False]
    os.utime(tmp_path / "a.ply", (5, 5))
    assert skipped(run(spec, out)) == [False, False]
    spec.write_text(spec.read_text().replace("publish: converted", "publish: converted, fine_tune: never"))
    assert skipped(run(spec, out)) == [False, False]
    assert skipped(run(spec, out)) == [True, True]


@pytest.mark.usefixtures("_fake_runs")
def test_failed_trials(tmp_path: Path, keyss: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors of users and internal errors."""
    spec = write_spec(tmp_path, ["broken.ply", "odd.ply", "a.ply"], seeds=1)
    broken, odd, good = run(spec, tmp_path / "out")
    assert "nothing of it can be read" in str(broken.error)
    assert odd.error == "RuntimeError: out of memory"
    assert "Traceback" in capsys.readouterr().err
    assert (good.error, good.result.numbers["cover.psnr"]) == (None, 30)
    said = keyss("sweep", spec, "-o", tmp_path / "out")
    assert said.status == 4
    assert "1 of 3 trials are done" in said.out
    assert "failed: broken-secret carry seed 0: " in said.out


def test_key_of_a_trial(tmp_path: Path, keyss: Run) -> None:
    (trial,) = run(real_spec(tmp_path, 1), tmp_path / "out")
    name, master = f"trial/{trial.folder.name}/1", tmp_path / "out" / "private" / "master-key.txt"
    key = keyss("keygen", "--asset", name, "--master-key-file", master).out.strip()
    assert len(library.reveal(trial.folder / "run" / "publish" / "model.ply", key).gaussians) == 40
    assert json.loads((trial.folder / "trial.json").read_text())["method"] == "carry"


def test_dry_run(keyss: Run, tmp_path: Path) -> None:
    spec, out = real_spec(tmp_path, 2), tmp_path / "out"
    before = sorted(tmp_path.rglob("*"))
    found = sweep(spec, out, dry_run=True)
    assert isinstance(found, Forecast)
    assert len(found.names) == len(found.costs) == 2
    assert all(cost.seconds > 0 and cost.memory_bytes > 10**8 for cost in found.costs.values())
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert said.status == 0, said
    assert "2 runs, 2 to do: about " in said.out
    assert "nothing was written." in said.out
    (tmp_path / "a.ply").write_text("ply, but no model")
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert "cannot work" in said.out
    assert "2 runs, 0 to do" in said.out
    assert sorted(tmp_path.rglob("*")) == before


# Ray warns of its own sockets and of forks.
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.argon2  # as in the processes of Ray
def test_local_ray_cluster(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    spec = real_spec(tmp_path, 2)
    (tmp_path / "broken.ply").write_text("no model")
    spec.write_text(
        spec.read_text().replace("methods:", "  - {cover: broken.ply, secrets: [a.ply]}\nmethods:")
    )
    here = run(spec, tmp_path / "here")
    shutil.copytree(tmp_path / "here" / "private", tmp_path / "there" / "private")
    there = run(spec, tmp_path / "there", ray="local")
    assert [each.error for each in there] == [each.error for each in here]
    assert sum(each.error is not None for each in there) == 2
    tables = [path for path in (tmp_path / "here").iterdir() if path.is_file()]
    assert len(tables) > 1
    for table in tables:
        assert table.read_bytes() == (tmp_path / "there" / table.name).read_bytes()


@pytest.mark.parametrize(("package", "extra", "ray"), [("ray", "cluster", "local"), ("yaml", "sweep", None)])
def test_missing_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, extra: str, ray: str | None
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    with pytest.raises(BackendError, match=rf"pip install 'keyss\[{extra}\]'"):
        run(spec, tmp_path / "out", ray=ray)
