"""A sweep: what it refuses, what it does once, and what is left after its processes were killed."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats

from cli.said import Run
from keyss.core import InputError, OutputError
from keyss.many import Forecast, ManyResult, cell, engines, sweep, sweeping, tables
from keyss.runs import MANIFEST
from many.fakes import DRIVER, REAL, fake, real_spec, training_spec, write_spec
from many.killing import kill_until_done, results
from other_processes import until
from test_api import write_nerfstudio
from tiny_scenes import tiny_scene

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


def test_a_grid_is_every_choice_with_every_other(files: Path) -> None:
    path = spec_of(files, GOOD)
    found = list(sweeping.variants(path, sweeping.read_spec(path)))
    chosen = [(each.options.sh_degree, each.options.fit.iterations) for each in found]  # type: ignore[attr-defined]
    assert chosen == [(1, 10), (1, 20), (3, 10), (3, 20)]
    assert all(each.options.fit.max_gaussians == 10_000 for each in found)  # of the preset


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pairs:", "piars:", "did you mean pairs"),
        ("cover: a.ply", "covr: a.ply", "did you mean cover"),
        ("cover: a.ply", "cover: c.ply", "pairs[0].cover: there is no c.ply"),
        ("cover: a.ply", "cover: 7", "Expected `str`, got `int`"),
        ("sh_degree:", "sh_degre:", "did you mean sh_degree"),
        ("fit.iterations:", "fit.iteration:", "did you mean fit.iterations"),
        ("[1, 3]", "[1, many]", "Expected `int | null`, got `str`"),
        ("[10, 20]", "[10, 0]", "expected 1 to 10000000, got 0"),
        ("[1, 3]", "[]", "length >= 1 - at `$.methods[0].grid[...]`"),
        ("method: carry", "method: carrry", "did you mean carry"),
        ("preset: quick", "preset: quik", "did you mean quick"),
        ("secrets: [b.ply]", "secrets: []", "length >= 1 - at `$.pairs[0].secrets`"),
        ("methods:", "seeds: [1, 1]\nmethods:", "got one twice"),
        ("methods:", "evaluate: [stelth]\nmethods:", "did you mean stealth"),
        ("methods:", "width: &x 3\nseeds: [*x]\nmethods:", "aliases"),
        ("methods:", "width: !!python/object/apply:os.system [ls]\nmethods:", "expected YAML"),
        ("{cover", "{{{cover", "expected YAML"),
        ("methods:", "  - {cover: b.ply, secrets: [a.ply], name: a-b}\nmethods:", "the name 'a-b' of [0]"),
        ("methods:", "methods:\n  - {method: carry, preset: default}", "[1]: has the name 'carry' of [0]"),
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


def test_deeply_nested_yaml_is_refused(files: Path) -> None:
    with pytest.raises(InputError):
        sweeping.read_spec(spec_of(files, "pairs: " + "[" * 100_000))


@pytest.mark.counted
def test_every_cell_runs_once_and_equal_sweeps_have_equal_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = write_spec(tmp_path, ["a.ply", "b.ply"], seeds=3)
    first = run(spec, tmp_path / "out", jobs=1)
    assert first.tables[:2] == ("results.csv", "cells.csv")
    assert [each.skipped for each in first.outcomes] == [False] * 6
    monkeypatch.setattr(engines, "WORKER", ("false",))  # nothing is left to do
    again = run(spec, tmp_path / "out")
    monkeypatch.setattr(engines, "WORKER", fake())
    assert [each.skipped for each in again.outcomes] == [True] * 6
    other = run(spec, tmp_path / "other", jobs=1)
    assert not other.failed
    for name in first.tables:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
    with (tmp_path / "out" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    # Numbers of the fake are 30, 31 and 32: t(0.975, 2) / sqrt(3) = 4.30265 / 1.73205.
    assert [(row["pair"], row["seeds"], row["mean"]) for row in rows] == [
        ("a-secret", "3", "31.0"),
        ("b-secret", "3", "31.0"),
    ]
    assert float(rows[0]["ci95_high"]) == pytest.approx(31 + 2.484138, abs=1e-5)


def test_a_cell_runs_again_when_its_data_options_or_result_changed(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=2)
    out = tmp_path / "out"
    cells = [each.folder for each in run(spec, out, jobs=1).outcomes]
    (cells[0] / "run" / "publish" / "model.ply").unlink()
    assert [each.skipped for each in run(spec, out, jobs=1).outcomes] == [False, True]
    spec.write_text(spec.read_text().replace("publish: any", "publish: any, prune_to_fit: true"))
    assert [each.skipped for each in run(spec, out, jobs=1).outcomes] == [False, False]
    (tmp_path / "a.ply").write_text("other content")
    cell.checksum.cache_clear()  # a process reads data once
    assert [each.skipped for each in run(spec, out, jobs=1).outcomes] == [False, False]
    assert len(list((out / "cells").iterdir())) == 6


@pytest.mark.counted
def test_a_folder_is_what_its_links_lead_to(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / "photos" / name).mkdir(parents=True)
        (tmp_path / "photos" / name / "0.png").write_text(name)
        (tmp_path / name).mkdir()
        (tmp_path / name / "images").symlink_to(tmp_path / "photos" / name)
    assert cell.checksum(str(tmp_path / "one")) != cell.checksum(str(tmp_path / "two"))
    (tmp_path / "one" / "again").symlink_to(tmp_path / "one")
    cell.checksum.cache_clear()
    with pytest.raises(InputError, match="again leads into itself"):
        cell.checksum(str(tmp_path / "one"))


def test_results_are_not_written_into_what_is_given_away(tmp_path: Path) -> None:
    publish = tmp_path / "run" / "publish"
    publish.mkdir(parents=True)
    (tmp_path / "run" / "private").mkdir()
    (tmp_path / "run" / MANIFEST).touch()
    with pytest.raises(OutputError, match="given away"):
        run(write_spec(tmp_path, ["a.ply"], seeds=1), publish / "sweep")


def test_a_folder_that_is_there_stays_open_to_whom_it_was(tmp_path: Path) -> None:
    out = tmp_path / "shared"
    out.mkdir(mode=0o755)
    run(write_spec(tmp_path, ["a.ply"], seeds=1), out, jobs=1)
    assert out.stat().st_mode & 0o777 == 0o755
    assert (out / "private").stat().st_mode & 0o077 == 0


@pytest.mark.counted
def test_ctrl_c_leaves_what_a_cell_has_trained(tmp_path: Path) -> None:
    """As a terminal does it: the signal goes to the whole group of processes."""
    spec = training_spec(tmp_path)
    command = [sys.executable, "-c", DRIVER, spec, tmp_path / "out", tmp_path / "master.txt", "real"]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE) as driver:
        until(lambda: any(" 40000 steps" in log.read_text() for log in tmp_path.glob("out/cells/*/log.txt")))
        os.killpg(driver.pid, signal.SIGINT)
        driver.communicate(timeout=60)
    assert list(tmp_path.glob("out/cells/*/run/private/checkpoint/*.safetensors"))


def test_what_dies_is_tried_again_and_what_is_refused_is_not(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["mortal.ply", "broken.ply", "a.ply"], seeds=1)
    result = run(spec, tmp_path / "out", jobs=1, retries=2)
    mortal, broken, good = result.outcomes
    assert mortal.result is not None
    assert good.result is not None
    assert (mortal.folder / "log.txt").read_text().count("begins") == 3
    assert (broken.folder / "log.txt").read_text().count("begins") == 1
    assert "nothing of it can be read" in str(broken.error)
    few = run(spec, tmp_path / "few", jobs=1, retries=1)
    assert [each.result is None for each in few.outcomes] == [True, True, False]


def test_keys_follow_from_one_master_key_and_stay_private(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    out = tmp_path / "out"
    (cell,) = run(spec, out, jobs=1).outcomes
    key_file = out / "private" / "master-key.txt"
    assert out.stat().st_mode & 0o077 == 0
    assert key_file.stat().st_mode & 0o077 == 0
    key = key_file.read_text().strip()
    others = [path for path in out.rglob("*") if path.is_file() and path != key_file]
    assert not any(key.encode() in path.read_bytes() for path in others)
    with pytest.raises(OutputError, match="another master key"):
        run(spec, out, jobs=1, master_key_file=tmp_path / "master.txt")
    assert json.loads((cell.folder / "cell.json").read_text())["key_names"] == [f"cell/{cell.folder.name}/1"]


@pytest.mark.counted
def test_two_sweeps_do_not_work_in_one_folder(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    out = tmp_path / "out"
    program = [sys.executable, "-c", DRIVER.replace("fake(0.5)", "fake(30)")]
    with subprocess.Popen([*program, spec, out, tmp_path / "master.txt", "fake"]) as driver:
        until(lambda: any(out.glob("cells/*/log.txt")))
        with pytest.raises(OutputError, match=f"process {driver.pid} is at work"):
            run(spec, out, jobs=1, master_key_file=tmp_path / "master.txt")
        driver.kill()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks at /proc")
@pytest.mark.parametrize("kills", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_any_moments_it_ends_as_if_nothing_had_happened(tmp_path: Path, kills: int) -> None:
    seeds = 2 if kills < 20 else 8
    spec = write_spec(tmp_path, ["a.ply", "b.ply", "c.ply"], seeds)
    calm = run(spec, tmp_path / "calm", jobs=4, master_key_file=tmp_path / "master.txt")
    killed = kill_until_done(spec, tmp_path / "out", "fake", kills, seed=kills, longest=0.6)
    assert len(killed) == kills
    assert kills < 20 or 0 < killed.count("driver") < kills
    for name in calm.tables:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()
    assert len(results(tmp_path / "out")) == 3 * seeds
    assert list((tmp_path / "out").rglob("*.unfinished")) == []


@pytest.mark.slow
def test_real_cells_that_were_killed_have_the_bytes_of_undisturbed_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "WORKER", REAL)
    spec, master = real_spec(tmp_path, 2), tmp_path / "master.txt"
    calm = run(spec, tmp_path / "calm", master_key_file=master)
    assert not calm.failed
    kill_until_done(spec, tmp_path / "out", "real", 2, seed=1, longest=6)
    for one, other in zip(
        sorted((tmp_path / "calm").glob("cells/*/run/publish/model.ply")),
        sorted((tmp_path / "out").glob("cells/*/run/publish/model.ply")),
        strict=True,
    ):
        assert one.read_bytes() == other.read_bytes()
    for name in calm.tables:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()


def test_a_dry_run_writes_nothing_and_names_what_cannot_work(keyss: Run, tmp_path: Path) -> None:
    spec, out = real_spec(tmp_path, 2), tmp_path / "out"
    before = sorted(tmp_path.rglob("*"))
    found = sweep(spec, out, dry_run=True)
    assert isinstance(found, Forecast)
    assert len(found.cells) == len(found.plans) == 2
    assert all(each.seconds > 0 and each.memory_bytes > 10**8 for each in found.plans)
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert said.status == 0, said
    assert "2 runs, 2 to do: about " in said.out
    assert "nothing was written." in said.out
    (tmp_path / "a.ply").write_text("ply, but no model")
    cell.checksum.cache_clear()
    found = sweep(spec, out, dry_run=True)
    assert isinstance(found, Forecast)
    assert all(each.refused for each in found.cells)
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert "cannot work" in said.out
    assert "2 runs, 0 to do" in said.out
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.counted
def test_scenes_are_fitted_once_for_all_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "WORKER", REAL)
    write_nerfstudio(tmp_path / "a", tiny_scene())
    spec = spec_of(
        tmp_path,
        "pairs: [{cover: a, secrets: [a]}]\n"
        "methods:\n"
        "  - {method: carry, options: {publish: any, fit.iterations: 20, fit.max_gaussians: 150}}\n"
        "  - {method: carry, name: dithered,\n"
        "     options: {publish: any, dither: true, fit.iterations: 20, fit.max_gaussians: 150}}\n"
        "bound: true\n",
    )
    found = run(spec, tmp_path / "out", jobs=1)
    assert [each.error for each in found.outcomes] == [None] * 2
    # Once as a cover and once, with more steps, as a secret.
    assert len(list((tmp_path / "out" / "cells").iterdir())) == 2 + 2
    assert len(list((tmp_path / "out").glob("cells/*/run/model.ply"))) == 2
    for each in found.outcomes:
        assert each.result is not None
        numbers = each.result.numbers
        assert numbers["baseline.cover.psnr"] == pytest.approx(numbers["cover.psnr"], abs=0.01)


@pytest.mark.parametrize("count", [2, 3, 10])
def test_intervals_are_scipy_s(count: int) -> None:
    values = np.random.default_rng(count).normal(30, 2, count)
    low, high = scipy.stats.t.interval(0.95, count - 1, values.mean(), scipy.stats.sem(values))
    assert tables.half_interval(list(values)) == pytest.approx((high - low) / 2, rel=1e-12)
    assert math.isnan(tables.half_interval([1.0]))


def test_tables_read_back_the_same(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    cells = [
        tables.CellNumbers(
            "a,b", "carry", {"mask": ["op", "ro"]}, seed, f"{seed}", {"x": seed / 3, "y": 1e-300}
        )
        for seed in range(4)
    ]
    tables.write_tables(tmp_path, cells)
    one = pandas.read_csv(tmp_path / "results.csv")
    assert list(one["mean"]) == [0.5, 1e-300]
    assert [each["seeds"] for each in tables.summaries(cells)] == [4, 4]
