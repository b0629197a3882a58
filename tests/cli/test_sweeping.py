"""`keyss sweep --dry-run`, which writes nothing, and `keyss key-of`, in this process."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path

from cli.said import Said
from keyss.keys.master import MasterKey
from sweeps.fakes import real_spec

MASTER = "q7Rv2LxT9bWm4KzDq7Rv2L"


def test_a_dry_run_estimates_every_cell_and_writes_nothing(
    keyss: Callable[..., Said], tmp_path: Path
) -> None:
    spec, out = real_spec(tmp_path, 2), tmp_path / "out"
    before = sorted(tmp_path.rglob("*"))
    said = keyss("sweep", spec, "-o", out, "--dry-run")
    assert said.status == 0, said
    assert "2 cells, 2 to do: about " in said.out
    assert "Nothing was written." in said.out
    assert sorted(tmp_path.rglob("*")) == before


def test_cells_that_cannot_work_are_named_beforehand(keyss: Callable[..., Said], tmp_path: Path) -> None:
    spec = real_spec(tmp_path, 1)
    (tmp_path / "a.ply").write_text("ply, but no model")
    said = keyss("sweep", spec, "-o", tmp_path / "out", "--dry-run")
    assert "cannot work" in said.out
    assert "1 cell, 0 to do" in said.out


def test_the_key_of_an_asset_follows_from_the_master_key(keyss: Callable[..., Said], tmp_path: Path) -> None:
    master = tmp_path / "master.txt"
    master.touch(mode=0o600)
    master.write_text(MASTER + "\n")
    expected = MasterKey(MASTER).key_of("statue-7")
    assert keyss("key-of", "statue-7", "--master-key-file", master).out == f"{expected}\n"
    out = tmp_path / "statue-7.key"
    said = keyss("key-of", "statue-7", "--master-key-file", master, "-o", out)
    assert said.status == 0, said
    assert out.read_text().strip() == expected
    assert expected not in said.out
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
