"""`keyss sweep --dry-run`, which writes nothing, in this process."""

from __future__ import annotations

from pathlib import Path

from cli.said import Run
from many.fakes import real_spec


def test_a_dry_run_estimates_every_cell_and_writes_nothing(keyss: Run, tmp_path: Path) -> None:
    spec, out = real_spec(tmp_path, 2), tmp_path / "out"
    before = sorted(tmp_path.rglob("*"))
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert said.status == 0, said
    assert "2 cells, 2 to do: about " in said.out
    assert "nothing was written." in said.out
    assert sorted(tmp_path.rglob("*")) == before


def test_cells_that_cannot_work_are_named_beforehand(keyss: Run, tmp_path: Path) -> None:
    spec = real_spec(tmp_path, 1)
    (tmp_path / "a.ply").write_text("ply, but no model")
    said = keyss("sweep", spec, "-o", tmp_path / "out", "--dry-run")
    assert "cannot work" in said.out
    assert "1 cell, 0 to do" in said.out
