"""Folders of other programs' trainings stand for their models."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from files.scene_files import write_colmap
from keyss.core import InputError, KeyssWarning
from keyss.files import load_scene, read_model, write_model
from keyss.rendering.orbit import is_model
from keyss.runs import ModelInfo
from keyss.runs.describe import info
from keyss.viewer import export_html
from tiny_scenes import random_gaussians

# Models in the folder of a training; the last one is the latest.
FOLDERS = {
    "inria": [f"point_cloud/iteration_{n}/point_cloud.ply" for n in (7000, 500, 30000)],
    "inria's models": [f"iteration_{n}/point_cloud.ply" for n in (7000, 30000)],
    "inria's iteration": ["point_cloud.ply"],
    "gsplat": [f"ply/point_cloud_{n}.ply" for n in (6999, 29999)],
    "gsplat's models": [f"point_cloud_{n}.ply" for n in (6999, 29999)],
    "nerfstudio's export": ["splat.ply"],
    "nerfstudio": ["exports/splat/splat.ply"],
}


@pytest.mark.parametrize("program", FOLDERS)
def test_latest_model_is_used(tmp_path: Path, program: str) -> None:
    folder, models = tmp_path / "run", []
    (folder / "ckpts").mkdir(parents=True)
    (folder / "ckpts" / "ckpt_29999_rank0.pt").write_bytes(b"PK\3\4")
    for seed, name in enumerate(FOLDERS[program]):
        models.append(random_gaussians(20 + seed, seed))
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_model(folder / name, models[-1])
    said = f"run: output of a training; its model is {FOLDERS[program][-1]}$"
    assert is_model(folder)
    with pytest.warns(KeyssWarning, match=said):
        assert read_model(folder).digest() == models[-1].digest()
    with pytest.warns(KeyssWarning, match=said):
        facts = info(folder)
    assert isinstance(facts, ModelInfo)
    assert facts.gaussians == len(models[-1])
    with pytest.warns(KeyssWarning, match=said):
        export_html(folder, tmp_path / "page.html")
    assert b"point_cloud.ply" in (tmp_path / "page.html").read_bytes() or "inria" not in program


@pytest.mark.parametrize("place", ["ckpts/ckpt_6999_rank0.pt", "nerfstudio_models/step-000029999.ckpt"])
def test_folders_of_checkpoints(tmp_path: Path, place: str) -> None:
    (tmp_path / place).parent.mkdir()
    (tmp_path / place).write_bytes(b"PK\3\4")
    assert not is_model(tmp_path)
    for read in (read_model, load_scene):
        with pytest.raises(InputError, match=r"found a folder of checkpoints of a training; .*ns-export"):
            read(tmp_path)


def test_unpacked_sog(tmp_path: Path) -> None:
    """The folder and its meta.json are read like the archive; images elsewhere are not."""
    write_model(tmp_path / "a.sog", random_gaussians(300))
    folder = tmp_path / "site"
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(folder)
    expected = read_model(tmp_path / "a.sog").digest()
    for path in (folder, folder / "meta.json"):
        assert is_model(path)
        assert read_model(path).digest() == expected
    whole = (folder / "meta.json").read_text()
    (folder / "meta.json").write_text(whole.replace("quats.webp", "../quats.webp"))
    with pytest.raises(InputError, match="expected images beside it"):
        read_model(folder)
    (folder / "meta.json").write_text(whole)
    (folder / "quats.webp").unlink()
    with pytest.raises(InputError, match=r"quats\.webp"):
        read_model(folder)
    (folder / "meta.json").write_text("{}")
    assert not is_model(folder)


def test_scene_that_contains_a_model(tmp_path: Path) -> None:
    write_model(write_colmap(tmp_path) / "splat.ply", random_gaussians(3))
    assert not is_model(tmp_path)
    assert len(load_scene(tmp_path).views) == 3
    with pytest.raises(InputError, match="found a folder"):
        read_model(tmp_path)
