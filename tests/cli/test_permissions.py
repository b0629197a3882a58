"""All commands in turn; other users can read only the published files."""

from __future__ import annotations

import json
import shutil
import stat
from pathlib import Path

import pytest

from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, Run
from files.scene_files import write_blender, write_nerfstudio
from keyss.demo import OPTIONS, run_demo
from keyss.files import read_model, write_model


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, umask: None) -> Path:
    """The working folder, with scenes `a` and `b` and models in `own/`."""
    write_blender(tmp_path / "a", count=3, channels=3)
    write_nerfstudio(tmp_path / "b", count=4)
    (tmp_path / "own").mkdir()
    write_model(tmp_path / "own" / "cover.ply", trained_like(400, 1))
    write_model(tmp_path / "own" / "secret.ply", trained_like(100, 2))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_all_commands(keyss: Run) -> None:
    def run(line: str) -> str:
        result = keyss(*line.split())
        assert result.status == 0, f"{line}: {result.err}"
        return result.out

    small = " ".join(SMALL)
    run("keygen -o key.txt")
    run(f"fit a -o plain {small}")
    run(f"hide --publish converted --cover a --secret b --key-file key.txt --min-psnr=0 -o hidden {small}")
    models = "--cover own/cover.ply --secret own/secret.ply --width 16 --device cpu"
    run(f"hide --method carry {models} --key-file key.txt -o carried")
    for name in ("hidden", "carried"):
        run(f"reveal {name}/publish/model.ply --key-file key.txt -o {name}.ply")
        run(f"verify {name}/publish/model.ply --key-file key.txt")
        metrics = json.loads(Path(name, "private", "metrics.json").read_text())
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in run(f"evaluate {name} --key-file key.txt")
        assert f"--seed {metrics['seed']}" in run(f"info {name}").splitlines()[0]
        found = json.loads(run(f"info {name}.ply --json"))
        assert found["gaussians"] == len(read_model(Path(f"{name}.ply"))) > 0
    assert run("render hidden.ply --cameras b -o images --split all").startswith("images: 4 images; ")
    assert len(list(Path("images").glob("*.png"))) == 4
    run("audit hidden --key-file key.txt --only parameters --controls 2 --device cpu")
    run("info hidden --json")


def readable_by_others(folder: Path) -> set[str]:
    return {
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    }


def published(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.glob("**/publish/*")}


PUBLISHED = {"hidden/publish/model.ply", "carried/publish/model.ply"}


def test_only_published_files_are_readable(keyss: Run, folder: Path) -> None:
    run_all_commands(keyss)
    for own in ("a", "b"):
        assert readable_by_others(folder / own)  # as the umask allows
        shutil.rmtree(folder / own)
    assert published(folder) == PUBLISHED
    shutil.rmtree(folder / "own")
    assert readable_by_others(folder) == PUBLISHED
    private = {path.parent.name: path for path in folder.glob("**/private")}
    assert private.keys() == {"plain", "hidden", "carried", "images"}
    for path in private.values():
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    for name in ("audit/audit.json", "report.md", "metrics.json", "config.json", "secret-1.ply"):
        assert (folder / "hidden" / "private" / name).is_file()
    results = {"plain", "hidden", "carried", "hidden.ply", "carried.ply", "images"}
    assert {path.name for path in folder.iterdir()} == {"key.txt", *results}


def test_demo_permissions(keyss: Run, tmp_path: Path, umask: None, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"options": OPTIONS.with_fit(iterations=20, max_gaussians=1500), "width": 32}
    monkeypatch.setattr(run_demo, "__kwdefaults__", run_demo.__kwdefaults__ | small)
    result = keyss("demo", "-o", tmp_path / "demo", "--device", "cpu")
    assert result.status == 0, result.err
    assert published(tmp_path) == {"demo/publish/model.ply"}
    assert readable_by_others(tmp_path) == {"demo/publish/model.ply", "demo/index.html", "demo/web.spz"}
    assert stat.S_IMODE((tmp_path / "demo" / "private").stat().st_mode) == 0o700
