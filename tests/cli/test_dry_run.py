"""`--dry-run` of `keyss hide` and `keyss fit` prints the plan and writes nothing."""

from __future__ import annotations

import re
from pathlib import Path

from cli.harness import SMALL, Run, listing, scene_arguments


def test_dry_run(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    scenes = scene_arguments(workspace)
    result = keyss("hide", "--publish", "converted", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0, result.err
    for words in ("capacity ", "cost ", " of memory", " of disk"):
        assert words in result.out, words
    assert re.search(r"up to [5-9]\d\d Gaussians of SH degree 3", result.out)
    assert "appended to the cover's 100" in result.out
    assert listing(tmp_path) == {}
    result = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0
    assert "falling back to --publish converted" in result.err  # too few for low bits
    assert listing(tmp_path) == {}


def test_dry_run_of_a_fit(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    result = keyss("fit", workspace / "a", "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0, result.err
    assert all(re.search(rf"^{word} +", result.out, re.M) for word in ("model", "training", "cost"))
    assert listing(tmp_path) == {}
