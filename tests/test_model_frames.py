"""Given models that do not show the photos of their scene, as programs export them in other frames."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from keyss.api.hide_arguments import in_frame_of
from keyss.core import Gaussians, InputError, KeyssWarning, Similarity
from keyss.files import write_model
from keyss.fitting import mean_psnr
from tiny_scenes import random_gaussians, tiny_scene

TURN = Similarity(
    0.3,
    torch.from_numpy(Rotation.from_euler("xyz", [70, 20, 130], degrees=True).as_matrix()),
    torch.tensor([0.4, -1, 2], dtype=torch.float64),
)
APPLIED = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]


def exported(folder: Path, frame: Similarity) -> tuple[Path, Gaussians]:
    """The scene's model in another frame, and the file that Nerfstudio writes about it."""
    model = TURN.apply_gaussians(random_gaussians())
    write_model(folder / "splat.ply", model)
    transform = torch.cat([frame.rotation, frame.translation[:, None] / frame.scale], dim=1)
    text = json.dumps({"transform": transform.tolist(), "scale": frame.scale})
    (folder / "dataparser_transforms.json").write_text(text)
    return folder / "splat.ply", model


def test_fitting_models_stay(tmp_path: Path) -> None:
    model = random_gaussians()
    assert in_frame_of(tiny_scene(), model, tmp_path / "model.ply", tmp_path) is model


def test_another_frame_is_named(tmp_path: Path) -> None:
    model = TURN.apply_gaussians(random_gaussians())
    with pytest.warns(
        KeyssWarning, match=r"worse than one colour.*another frame.*dataparser_transforms\.json"
    ):
        assert in_frame_of(tiny_scene(), model, tmp_path / "model.ply", tmp_path) is model


@pytest.mark.parametrize("applied", [None, APPLIED])
def test_nerfstudio_s_frame_is_read(tmp_path: Path, applied: list[list[int]] | None) -> None:
    """The file's transform begins in the frame of the photos, or in COLMAP's before `applied_transform`."""
    scene, frame = tiny_scene(), TURN
    if applied is not None:
        before = Similarity(1.0, torch.tensor(applied, dtype=torch.float64)[:, :3])
        frame = Similarity(TURN.scale, TURN.rotation @ before.rotation, TURN.translation)
        (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": applied, "frames": []}))
    path, model = exported(tmp_path, frame)
    with pytest.warns(KeyssWarning, match="is moved into the frame of its photos"):
        moved = in_frame_of(scene, model, path, tmp_path)
    assert mean_psnr(moved, scene.test, scene.background) > 40


def test_broken_transforms(tmp_path: Path) -> None:
    path, model = exported(tmp_path, TURN)
    (tmp_path / "dataparser_transforms.json").write_text('{"transform": [[1, 2]], "scale": 0}')
    with pytest.raises(InputError, match="expected Nerfstudio's transform"):
        in_frame_of(tiny_scene(), model, path, tmp_path)
