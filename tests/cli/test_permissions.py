"""From keys to a report, with the usual umask: only what is to be published is readable by others."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path

import pytest

from channels.quiet.trained_like import trained_like
from cli.harness import SMALL, Result, Run
from files.scene_files import write_blender, write_nerfstudio
from keyss.demo import OPTIONS, run_demo
from keyss.files import write_model


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, umask: None) -> Path:
    """Scenes `a` and `b`, and models in `own/`; the working folder."""
    write_blender(tmp_path / "a", count=3, channels=3)
    write_nerfstudio(tmp_path / "b", count=4)
    (tmp_path / "own").mkdir()
    write_model(tmp_path / "own" / "cover.ply", trained_like(400, 1))
    write_model(tmp_path / "own" / "secret.ply", trained_like(100, 2))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tour(keyss: Run) -> None:
    """Every verb, into the working folder."""

    def done(line: str) -> Result:
        result = keyss(*line.split())
        assert result.status == 0, f"{line}: {result.err}"
        return result

    small = " ".join(SMALL)
    done("keygen -o key.txt")
    done(f"fit a -o plain {small}")
    done(f"hide --publish any --cover a --secret b --key-file key.txt --min-psnr=0 -o hidden {small}")
    models = "--cover own/cover.ply --secret own/secret.ply --width 16 --device cpu"
    done(f"hide --method carry {models} --key-file key.txt -o carried")
    for run in ("hidden", "carried"):
        done(f"reveal {run}/publish/model.ply --key-file key.txt -o {run}.ply")
        done(f"verify {run}/publish/model.ply --key-file key.txt")
        done(f"evaluate {run} --key-file key.txt")
        done(f"info {run}/publish/model.ply")
    done("render hidden.ply --cameras b -o images --split all")
    done("audit hidden --key-file key.txt --only parameters --controls 2 --device cpu")
    done("audit hidden --report-only")
    done("info hidden --json")


def readable_by_others(folder: Path) -> set[str]:
    return {
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    }


def published(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.glob("**/publish/*")}


PUBLISHED = {"hidden/publish/model.ply", "carried/publish/model.ply"}


def test_only_published_files_are_readable(keyss: Run, mine: Path) -> None:
    tour(keyss)
    for own in ("a", "b"):
        assert readable_by_others(mine / own)  # the umask is one under which that means something
        shutil.rmtree(mine / own)
    assert published(mine) == PUBLISHED
    shutil.rmtree(mine / "own")  # written by keyss's own writer
    assert readable_by_others(mine) == PUBLISHED
    private = {path.parent.name: path for path in mine.glob("**/private")}
    assert private.keys() == {"plain", "hidden", "carried", "images"}
    for path in private.values():
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    for name in ("audit/audit.json", "report.html", "metrics.json", "config.json", "secret-1.ply"):
        assert (mine / "hidden" / "private" / name).is_file()
    results = {"plain", "hidden", "carried", "hidden.ply", "carried.ply", "images"}
    assert {path.name for path in mine.iterdir()} == {"key.txt", *results}


def test_demo_permissions(keyss: Run, tmp_path: Path, umask: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A demo of a few steps on small photos."""
    small = {"options": OPTIONS.with_fit(iterations=20, max_gaussians=1500), "width": 32}
    monkeypatch.setattr(run_demo, "__kwdefaults__", run_demo.__kwdefaults__ | small)
    result = keyss("demo", "-o", tmp_path / "demo", "--device", "cpu")
    assert result.status == 0, result.err
    assert published(tmp_path) == {"demo/publish/model.ply"}
    assert readable_by_others(tmp_path) == {"demo/publish/model.ply", "demo/index.html"}
    assert stat.S_IMODE((tmp_path / "demo" / "private").stat().st_mode) == 0o700
