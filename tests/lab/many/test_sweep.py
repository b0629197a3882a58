"""A sweep: what it refuses, what it runs once, and what is left where it was interrupted."""

from __future__ import annotations

import csv
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.said import Run
from keyss.core import BackendError, InputError
from keyss.lab.many import Forecast, ManyResult, sweep
from tiny_scenes import random_gaussians

fake_runs = pytest.mark.usefixtures("_fake_runs")

GOOD = """
pairs:
  - {cover: a.ply, secrets: [b.ply]}
methods:
  - {method: carry, preset: quick, grid: {sh_degree: [1, 3], fit.iterations: [10, 20]}}
"""


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(name)
    return tmp_path


def run(*arguments: Any, **options: Any) -> ManyResult:
    """A sweep that is no dry run."""
    found = sweep(*arguments, **options)
    assert isinstance(found, ManyResult)
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
        ("sh_degree:", "sh_degre:", "did you mean sh_degree"),
        ("fit.iterations:", "fit.iteration:", "did you mean fit.iterations"),
        ("[1, 3]", "[1, many]", "Expected `int | null`, got `str`"),
        ("[10, 20]", "[10, 0]", "expected 1 to 10000000, got 0"),
        ("[1, 3]", "[]", "length >= 1 - at `$.methods[0].grid[...]`"),
        ("method: carry", "method: carrry", "Invalid enum value 'carrry'"),
        ("preset: quick", "preset: quik", "Invalid enum value 'quik'"),
        ("secrets: [b.ply]", "secrets: []", "length >= 1 - at `$.pairs[0].secrets`"),
        ("methods:", "seeds: [1, 1]\nmethods:", "got one twice"),
        ("methods:", "evaluate: [stelth]\nmethods:", "Invalid enum value 'stelth'"),
        ("methods:", "width: !!python/object/apply:os.system [ls]\nmethods:", "expected YAML"),
        ("{cover", "{{{cover", "expected YAML"),
        (
            "methods:",
            "  - {cover: b.ply, secrets: [a.ply], name: a-b}\nmethods:",
            "pairs: two have the name 'a-b'",
        ),
        ("methods:", "methods:\n  - {method: carry, preset: default}", "methods: two have the name 'carry'"),
    ],
)
def test_what_is_wrong_in_a_specification_is_said_before_anything_runs(
    files: Path, old: str, new: str, words: str
) -> None:
    assert old in GOOD
    path = spec_of(files, GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        run(path, files / "out")
    assert words in str(caught.value)
    assert not (files / "out").exists()


def write_spec(folder: Path, covers: list[str], seeds: int, more: str = "") -> Path:
    """A sweep of files that need not be models."""
    for name in (*covers, "secret.ply"):
        if not (folder / name).exists():
            (folder / name).write_text(name)
    pairs = "\n".join(f"  - {{cover: {name}, secrets: [secret.ply]}}" for name in covers)
    (folder / "master.txt").write_text("q7Rv2LxT9bWm4KzDq7Rv2L\n")
    text = f"pairs:\n{pairs}\nmethods:\n  - {{method: carry, options: {{publish: any}}}}\n"
    return spec_of(folder, f"{text}seeds: {list(range(seeds))}\n{more}")


def real_spec(folder: Path, seeds: int) -> Path:
    """A sweep of real models, of almost no size."""
    library.write_model(folder / "a.ply", random_gaussians(300, seed=0))
    library.write_model(folder / "secret.ply", random_gaussians(40, seed=1))
    return write_spec(folder, ["a.ply"], seeds, "width: 32\n")


def skipped(found: ManyResult) -> list[bool]:
    return [each.skipped for each in found.outcomes]


@fake_runs
def test_every_cell_runs_once_and_equal_sweeps_have_equal_tables(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply", "b.ply"], seeds=3)
    first = run(spec, tmp_path / "out")
    assert first.tables == ("results.csv", "cells.csv", "scenes.csv", "scenes.tex")
    assert skipped(first) == [False] * 6
    assert skipped(run(spec, tmp_path / "out")) == [True] * 6
    run(spec, tmp_path / "other")
    for name in first.tables:
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
    ] == [
        ("a", "cover", "31.0", "1.0", ""),
        ("secret", "secret", "20.0", "0.0", ""),
    ]
    assert "seconds" not in (tmp_path / "out" / "cells.csv").read_text()  # they differ from run to run


@fake_runs
def test_a_cell_runs_again_when_its_files_options_or_result_changed(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=2)
    out = tmp_path / "out"
    cells = [each.folder for each in run(spec, out).outcomes]
    (cells[0] / "run" / "publish" / "model.ply").unlink()
    assert skipped(run(spec, out)) == [False, True]
    written = (cells[0] / "result.json").stat().st_mtime
    os.utime(tmp_path / "a.ply", (written + 5, written + 5))
    assert skipped(run(spec, out)) == [False, False]
    os.utime(tmp_path / "a.ply", (written - 5, written - 5))
    spec.write_text(spec.read_text().replace("publish: any", "publish: any, refit: never"))
    assert skipped(run(spec, out)) == [False, False]
    assert skipped(run(spec, out)) == [True, True]
    assert len(list((out / "cells").iterdir())) == 4


@fake_runs
def test_a_cell_that_fails_does_not_end_the_others(
    tmp_path: Path, keyss: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither with an error that keyss expects nor with another."""
    spec = write_spec(tmp_path, ["broken.ply", "odd.ply", "a.ply"], seeds=1)
    broken, odd, good = run(spec, tmp_path / "out").outcomes
    assert "nothing of it can be read" in str(broken.error)
    assert odd.error == "RuntimeError: out of memory"
    assert "Traceback" in capsys.readouterr().err
    assert (good.error, good.result.numbers["cover.psnr"]) == (None, 30)
    said = keyss("sweep", spec, "-o", tmp_path / "out")
    assert said.status == 4
    assert "1 of 3 cells are done" in said.out
    assert "failed: broken-secret carry seed 0: " in said.out


def test_the_key_of_a_cell_opens_it(tmp_path: Path, keyss: Run) -> None:
    (cell,) = run(real_spec(tmp_path, 1), tmp_path / "out").outcomes
    name, master = f"cell/{cell.folder.name}/1", tmp_path / "out" / "private" / "master-key.txt"
    key = keyss("keygen", "--asset", name, "--master-key-file", master).out.strip()
    assert len(library.reveal(cell.folder / "run" / "publish" / "model.ply", key).gaussians) == 40
    assert json.loads((cell.folder / "cell.json").read_text())["method"] == "carry"


def test_a_dry_run_writes_nothing_and_names_what_cannot_work(keyss: Run, tmp_path: Path) -> None:
    spec, out = real_spec(tmp_path, 2), tmp_path / "out"
    before = sorted(tmp_path.rglob("*"))
    found = sweep(spec, out, dry_run=True)
    assert isinstance(found, Forecast)
    assert len(found.names) == len(found.plans) == 2
    assert all(each.seconds > 0 and each.memory_bytes > 10**8 for each in found.plans.values())
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
def test_a_local_cluster_does_the_same_cells(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    spec = real_spec(tmp_path, 2)
    (tmp_path / "broken.ply").write_text("no model")
    spec.write_text(
        spec.read_text().replace("methods:", "  - {cover: broken.ply, secrets: [a.ply]}\nmethods:")
    )
    here = run(spec, tmp_path / "here", master_key_file=tmp_path / "master.txt")
    there = run(spec, tmp_path / "there", master_key_file=tmp_path / "master.txt", ray="local")
    assert [each.error for each in there.outcomes] == [each.error for each in here.outcomes]
    assert len(there.errors) == 2
    for name in here.tables:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()


@pytest.mark.parametrize(("package", "ray"), [("ray", "local"), ("yaml", None)])
def test_without_a_package_one_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, ray: str | None
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    with pytest.raises(BackendError, match=r"pip install 'keyss\[sweep\]'"):
        run(spec, tmp_path / "out", ray=ray)
