"""A sweep: what it refuses, what it runs once, and what is left where it was interrupted."""

from __future__ import annotations

import csv
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

import keyss as library
from cli.said import Run
from keyss.core import BackendError, InputError, OutputError
from keyss.lab.many import Forecast, ManyResult, cell_folder, sweep, sweep_spec
from keyss.lab.many.engine import claim_folder
from keyss.progress import Reporter
from keyss.runs import MANIFEST
from lab.many.conftest import fake_run
from test_api import write_nerfstudio
from tiny_scenes import random_gaussians, tiny_scene

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


def test_a_grid_is_every_choice_with_every_other(files: Path) -> None:
    path = spec_of(files, GOOD)
    found = [options for _, options, _ in sweep_spec.variants(path, sweep_spec.read_spec(path))]
    chosen = [(each.sh_degree, each.fit.iterations) for each in found]  # type: ignore[attr-defined]
    assert chosen == [(1, 10), (1, 20), (3, 10), (3, 20)]
    assert all(each.fit.max_gaussians == 10_000 for each in found)  # of the preset


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


def test_deeply_nested_yaml_is_refused(files: Path) -> None:
    with pytest.raises(InputError):
        sweep_spec.read_spec(spec_of(files, "pairs: " + "[" * 100_000))


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
    spec.write_text(spec.read_text().replace("publish: any", "publish: any, prune_to_fit: true"))
    assert skipped(run(spec, out)) == [False, False]
    assert skipped(run(spec, out)) == [True, True]
    assert len(list((out / "cells").iterdir())) == 4


def test_results_are_not_written_into_what_is_given_away(tmp_path: Path) -> None:
    publish = tmp_path / "run" / "publish"
    publish.mkdir(parents=True)
    (tmp_path / "run" / "private").mkdir()
    (tmp_path / "run" / MANIFEST).touch()
    with pytest.raises(OutputError, match="given away"):
        run(write_spec(tmp_path, ["a.ply"], seeds=1), publish / "sweep")


@fake_runs
def test_a_folder_that_is_there_stays_open_to_whom_it_was(tmp_path: Path) -> None:
    out = tmp_path / "shared"
    out.mkdir(mode=0o755)
    run(write_spec(tmp_path, ["a.ply"], seeds=1), out)
    assert out.stat().st_mode & 0o777 == 0o755
    assert (out / "private").stat().st_mode & 0o077 == 0


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


def test_after_ctrl_c_finished_cells_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, out = write_spec(tmp_path, ["a.ply"], seeds=3), tmp_path / "out"

    def interrupted(job: Any, folder: Path, reporter: Reporter) -> Any:
        if job.options.fit.seed == 1:
            raise KeyboardInterrupt
        return fake_run(job, folder, reporter)

    monkeypatch.setattr(cell_folder, "run_cell", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(spec, out)
    monkeypatch.setattr(cell_folder, "run_cell", fake_run)
    assert skipped(run(spec, out)) == [True, False, False]


class Interrupting(Reporter):
    """Interrupts the second training after a few steps."""

    trainings = 0

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, line: str) -> None:
        self.notes.append(line)

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.trainings += 1

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if self.trainings == 2 and iteration == 5:
            signal.raise_signal(signal.SIGINT)


class Noting(Reporter):
    """Notes at which step trainings begin."""

    def __init__(self) -> None:
        self.starts: list[int] = []

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.starts.append(iteration)


def test_a_training_goes_on_where_ctrl_c_stopped_it_and_scenes_are_fitted_once(tmp_path: Path) -> None:
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
    interrupting = Interrupting()
    with pytest.raises(KeyboardInterrupt):
        run(spec, tmp_path / "out", reporter=interrupting)
    assert interrupting.notes[-1] == "interrupted: the same command resumes"
    noted = Noting()
    found = run(spec, tmp_path / "out", reporter=noted)
    assert [each.error for each in found.outcomes] == [None] * 2
    assert noted.starts[0] == 5
    # Once as a cover and once, with more steps, as a secret.
    assert len(list((tmp_path / "out").glob("cells/*/run/model.ply"))) == 2
    assert len(list((tmp_path / "out" / "cells").iterdir())) == 2 + 2
    for each in found.outcomes:
        numbers = each.result.numbers
        assert numbers["baseline.cover.psnr"] == pytest.approx(numbers["cover.psnr"], abs=0.01)


@fake_runs
def test_keys_follow_from_one_master_key_and_stay_private(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    out = tmp_path / "out"
    run(spec, out)
    key_file = out / "private" / "master-key.txt"
    assert out.stat().st_mode & 0o077 == 0
    assert key_file.stat().st_mode & 0o077 == 0
    key = key_file.read_text().strip()
    others = [path for path in out.rglob("*") if path.is_file() and path != key_file]
    assert not any(key.encode() in path.read_bytes() for path in others)
    with pytest.raises(OutputError, match="another master key"):
        run(spec, out, master_key_file=tmp_path / "master.txt")


def test_the_key_of_a_cell_opens_it(tmp_path: Path, keyss: Run) -> None:
    (cell,) = run(real_spec(tmp_path, 1), tmp_path / "out").outcomes
    name, master = f"cell/{cell.folder.name}/1", tmp_path / "out" / "private" / "master-key.txt"
    key = keyss("keygen", "--asset", name, "--master-key-file", master).out.strip()
    assert len(library.reveal(cell.folder / "run" / "publish" / "model.ply", key).gaussians) == 40
    assert json.loads((cell.folder / "cell.json").read_text())["method"] == "carry"


def test_two_sweeps_do_not_work_in_one_folder(tmp_path: Path) -> None:
    spec = write_spec(tmp_path, ["a.ply"], seeds=1)
    with claim_folder(tmp_path / "out"), pytest.raises(OutputError, match="another process"):
        run(spec, tmp_path / "out")


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
