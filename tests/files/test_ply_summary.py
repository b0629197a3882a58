"""The summary of a .ply agrees with the model that is read, and needs neither it nor torch."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from files.formats.examples import model_of
from keyss.files import read_model, write_model
from keyss.files.ply_table import NEARLY_TRANSPARENT, model_names, ply_header, summarise_ply

VALUES = (np.nan, np.inf, -np.inf, 3e38, -3e38)  # sums of the last two overflow


def damaged(path: Path, seed: int, count: int = 9000, kind: str = "float") -> None:
    """A .ply of random values and of a few extreme ones, perhaps in two types."""
    rng = np.random.default_rng(seed)
    names = model_names(4)
    rows = rng.normal(-1, 2, (count, len(names))).astype("<f4")
    for value in VALUES[: seed % 6]:
        rows[rng.integers(0, count, 3), rng.integers(0, len(names), 3)] = value
    table = np.zeros(count, [(name, "<f8" if kind != "float" and name == "y" else "<f4") for name in names])
    for index, name in enumerate(names):
        table[name] = rows[:, index]
    listed = [f"{'double' if table.dtype[name] == '<f8' else 'float'} {name}" for name in names]
    path.write_bytes(ply_header({"vertex": (count, listed)}) + table.tobytes())


@pytest.mark.parametrize("kind", ["float", "two types"])
@pytest.mark.parametrize("seed", range(12))
def test_summary_matches_model(tmp_path: Path, seed: int, kind: str) -> None:
    path = tmp_path / "a.ply"
    damaged(path, seed, kind=kind)
    with warnings.catch_warnings(record=True) as of_model:
        warnings.simplefilter("always")
        model = read_model(path)
    with warnings.catch_warnings(record=True) as of_summary:
        warnings.simplefilter("always")
        summary = summarise_ply(path)
    assert summary is not None
    assert [str(each.message) for each in of_summary] == [str(each.message) for each in of_model]
    assert (summary.gaussians, summary.sh_degree) == (len(model), model.sh_degree)
    assert summary.low.tolist() == model.means.amin(0).tolist()
    assert summary.high.tolist() == model.means.amax(0).tolist()
    assert summary.nearly_transparent == int((model.opacity_logits < NEARLY_TRANSPARENT).sum())


def test_other_files_have_no_summary(tmp_path: Path) -> None:
    for name in ("a.spz", "a.compressed.ply"):
        write_model(tmp_path / name, model_of(300, 1))
        assert summarise_ply(tmp_path / name) is None
    assert summarise_ply(tmp_path / "missing.ply") is None


def test_info_of_a_ply_imports_no_torch(tmp_path: Path) -> None:
    write_model(tmp_path / "a.ply", model_of(300, 1))
    code = (
        "import sys; from keyss.runs.describe import info; info(sys.argv[1]); print('torch' in sys.modules)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.ply")]
    done = subprocess.run(command, check=True, timeout=60, capture_output=True, text=True)
    assert done.stdout.strip() == "False"
