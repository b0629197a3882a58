"""Comparisons of methods."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from keyss import compare
from keyss.cli import main
from keyss.core import InputError, OutputError, UsageError
from keyss.lab import Auc
from keyss.lab.audits import trial_measures
from keyss.lab.many import Forecast, comparison, trial
from keyss.lab.many.trial_folder import claim_folder
from keyss.methods import registry

SMALL = ["--iterations", "60", "--max-gaussians", "240", "--seed", "3"]


def test_comparison_and_resume(
    folders: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    out = tmp_path / "compared"
    names = "3dgs,3dgs-sh,carry"
    # Trees take seconds; `tests/lab/audits` has the real ones.
    monkeypatch.setattr(
        trial_measures,
        "two_sample_auc",
        lambda a, b: Auc(float((a.means.mean() - b.means.mean()).abs()), 0, 0),
    )

    def refuse(*_: object) -> None:
        raise UsageError("no room")

    monkeypatch.setattr(type(registry.get("carry")), "prepare", refuse)
    command = ["compare", "--cover", str(folders[0]), "--secret", str(folders[1]), *SMALL, "-o", str(out)]
    monkeypatch.setattr(comparison, "EVERY", tuple(names.split(",")))
    assert main([*command, "--methods", names]) == 2
    assert "carry: not possible: no room" in capsys.readouterr().err
    assert main([*command, "--dry-run"]) == 0
    assert not out.exists()
    assert "7 runs, 6 to do" in capsys.readouterr().out  # four plain models and three methods
    assert main([*command, "--methods", "3dgs,3dgs-sh"]) == 0
    before = {path: path.stat().st_mtime_ns for path in out.rglob("result.json")}
    assert len(before) == 4 + 2
    capsys.readouterr()
    assert main(command) == 0
    assert before.items() <= {path: path.stat().st_mtime_ns for path in out.rglob("result.json")}.items()
    said = capsys.readouterr().out
    assert "carry: not possible" in said
    found = json.loads((out / "comparison.json").read_text())
    rows = {row["name"]: row for row in found["methods"]}
    assert list(rows) == names.split(",")
    assert rows["carry"]["error"] == "no room"
    numbers = {name: row["numbers"] for name, row in rows.items() if not row["error"]}
    assert numbers["3dgs"]["cover.psnr"] >= numbers["3dgs-sh"]["cover.psnr"] - 1
    assert 1e6 * numbers["3dgs-sh"]["files.companion_mb"] > numbers["3dgs-sh"]["gaussians"] * 16 * 3 * 4
    assert [rows[name]["keys"] for name in names.split(",")] == [False, False, True]
    assert {(number["steps.1"], number["steps.2"]) for number in numbers.values()} == {(60, 60)}
    # The companion files belong to every row, and those of `3dgs` have other places.
    assert "survival.pruned, cover" in numbers["3dgs-sh"]
    assert "survival.pruned, secret" not in numbers["3dgs-sh"]
    kept = {name: value for name, value in numbers["3dgs"].items() if name.startswith("survival.")}
    assert {f"survival.{name}, cover" for name in ("pruned", ".spz", "purified")} <= set(kept)
    secrets = [value for name, value in kept.items() if name.endswith(", secret")]
    assert secrets == pytest.approx([0] * len(secrets))
    assert {f"secrecy.{each}" for each in ("classifier", "stealth", "stegexpose")} <= set(numbers["3dgs"])
    assert main([*command, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "0 to do" in said
    assert "carry: " in said
    with Image.open(out / "comparison.png") as picture:
        assert picture.height > 3 * 200  # photos and two methods
    assert (out / "private" / "master-key.txt").stat().st_mode & 0o77 == 0


def test_invalid_arguments(folders: tuple[Path, Path], tmp_path: Path) -> None:
    for methods, words in ((["3dgs", "lerned"], "lerned"), (["carry:worst"], "worst")):
        with pytest.raises(UsageError, match=words):
            compare(*folders, methods=methods, out=tmp_path / "out")
    with pytest.raises(UsageError, match="models have none"):
        compare(tmp_path / "a.ply", folders[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert set(registry.METHODS) >= {"3dgs", "3dgs-sh", "3dgs-decoder", "watergs", "gs-hider"}


@pytest.mark.parametrize("verb", ["hide", "fit"])
def test_all_methods_fail(
    folders: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    verb: str,
) -> None:
    real, out = getattr(trial, verb), tmp_path / "out"

    def full(*arguments: object, **more: object) -> object:
        if more.get("dry_run"):
            return real(*arguments, **more)
        raise InputError("the disk is full")

    monkeypatch.setattr(trial, verb, full)
    command = ["compare", "--cover", str(folders[0]), "--secret", str(folders[1]), *SMALL, "-o", str(out)]
    assert main([*command, "--methods", "3dgs"]) == 4
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == "keyss: error: not possible: 3dgs"
    assert "3dgs: not possible: the disk is full" in said.out
    assert not (out / "comparison.png").exists()


def test_default_budget_and_lock(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """The default budget is that of the first method's preset."""
    found = compare(*folders, methods=["carry:quick", "3dgs"], out=tmp_path / "out", dry_run=True)
    assert isinstance(found, Forecast)
    assert {name.partition(", ")[2] for name in found.names.values()} >= {"500 steps, 10,000 Gaussians"}
    assert len({*found.names.values()}) == len(found.names)
    with claim_folder(tmp_path / "out"), pytest.raises(OutputError, match="another process"):
        compare(*folders, methods=["carry:quick"], out=tmp_path / "out")
