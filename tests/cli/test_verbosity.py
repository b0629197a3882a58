"""-q, -v, and what is said before long work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cli.said import SMALL, Run, Said
from keyss import progress


def fit(keyss: Run, scene: Path, *more: object) -> Said:
    return keyss("fit", scene, "-o", scene.parent / "out", "--seed", 0, *SMALL[2:], *more)


@pytest.mark.parametrize("flag", ["-q", "--quiet"])
def test_quiet_leaves_progress_out_and_results_in(keyss: Run, scene: Path, flag: str) -> None:
    usual = fit(keyss, scene)
    assert "fit b: 20 steps" in usual.err
    quiet = fit(keyss, scene, "--overwrite", flag)
    assert (quiet.status, quiet.err) == (0, "")
    assert quiet.out.split("seconds")[0] == usual.out.split("seconds")[0]
    assert progress.level == 0


def test_quiet_leaves_errors_and_warnings_in(keyss: Run, tmp_path: Path) -> None:
    assert keyss("-q", "info", tmp_path / "no.ply").err.startswith("keyss: error: ")


@pytest.mark.parametrize("flag", ["-v", "--verbose"])
def test_verbose_tells_the_time_at_the_end(keyss: Run, scene: Path, flag: str) -> None:
    said = keyss(flag, *("fit", scene, "-o", scene.parent / "out", *SMALL[2:]))
    assert re.search(r"\nkeyss: done in \d+\.\d s\n$", said.err)
    assert progress.level == 0
    assert "done in" not in keyss(flag, "info", scene.parent / "no.ply").err


class TestEstimate:
    """Long work begins with one; what is over in seconds does not."""

    @pytest.fixture(autouse=True)
    def soon_long(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("keyss.runs.planning._LONG", 20)

    WORDS = r"a file of up to \d+\.\d MB, about \d+ s, \d\.\d GB of memory, up to \d+ MB of disk"

    def test_of_fit(self, keyss: Run, scene: Path) -> None:
        said = fit(keyss, scene)
        assert re.search(rf"^fit: {self.WORDS}\n.*fit b: 20 steps", said.err, re.DOTALL)
        assert "about" not in fit(keyss, scene, "-q", "--overwrite").err

    def test_of_hide(self, keyss: Run, world: Path, tmp_path: Path) -> None:
        scenes = ("--cover", world / "a", "--secret", world / "b", "--key-file", world / "key.txt")
        said = keyss("hide", "--publish", "any", *scenes, "-o", tmp_path / "out", *SMALL, "--min-psnr", 0)
        assert said.status == 0, said.err
        assert re.search(rf"^hide: {self.WORDS}\n", said.err, re.MULTILINE)
