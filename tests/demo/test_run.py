"""The demo at a small size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import keyss
from keyss import CarryOptions, demo
from keyss.core import Interrupted, OutputError
from keyss.files import load_scene
from keyss.fitting import FitConfig
from keyss.lab.audits.audit_run import KEPT
from keyss.runs import HideMetrics, read_record
from keyss.runs.folder import RunFolder

SMALL: dict[str, Any] = {
    # So small a model has no room in low bits.
    "options": CarryOptions(fit=FitConfig(iterations=30, max_gaussians=300), publish="converted"),
    "width": 32,
    "device": "cpu",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, HideMetrics]:
    out = tmp_path_factory.mktemp("demo") / "out" / "demo"
    return out, demo.run_demo(out, seed=3, **SMALL)


def test_output_files(run: tuple[Path, HideMetrics]) -> None:
    out, metrics = run
    assert {path.name for path in out.iterdir()} == {
        *("publish", "private", "scenes", "secret.ply", "web.spz", "comparison.png", "key.txt", "index.html"),
    }
    assert metrics.baseline.steps == metrics.steps == (30, 64)
    assert all(metrics.baseline.equal)
    assert metrics == read_record(out / "private" / "metrics.json", HideMetrics)
    assert (out / "key.txt").read_text() == "demo-key-3\n"
    with Image.open(out / "comparison.png") as picture:
        assert picture.size[0] > 5 * 240


def test_key_reveals_the_published_files(run: tuple[Path, HideMetrics], tmp_path: Path) -> None:
    out, _ = run
    revealed = keyss.reveal(out / "publish" / "model.ply", "demo-key-3", out=tmp_path / "again.ply").gaussians
    assert (tmp_path / "again.ply").read_bytes() == (out / "secret.ply").read_bytes()
    assert len(keyss.reveal(out / "web.spz", "demo-key-3").gaussians) == len(revealed)


def test_audits_keep_the_demo(run: tuple[Path, HideMetrics]) -> None:
    out, _ = run
    RunFolder(out, "audit", onto=KEPT)  # raises OutputError if it would replace any file


def test_existing_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "stego.ply").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="`overwrite=True`"):
        demo.run_demo(tmp_path, **SMALL)
    assert (tmp_path / "stego.ply").read_text() == "old"

    def interrupted(*args: object, **kwargs: object) -> None:
        raise Interrupted(tmp_path / "checkpoint", 5)

    monkeypatch.setattr(keyss, "hide", interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:
        demo.run_demo(tmp_path, overwrite=True, **SMALL)
    assert not isinstance(caught.value, Interrupted)
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", "stego.ply"}
    with pytest.raises(KeyboardInterrupt):
        demo.run_demo(tmp_path / "new", **SMALL)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("which", [demo.COVER, demo.SECRET])
def test_bundled_scenes(which: str) -> None:
    scene = load_scene(demo.FOLDER / which)
    assert (len(scene.train), len(scene.test)) == (42, 6)
    assert {tuple(view.image.shape) for view in scene.views} == {(120, 160, 3)}
    assert scene.points is not None
    assert scene.points.shape == (3000, 3)
