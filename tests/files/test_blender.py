"""Scenes in the layout of NeRF-synthetic."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from files.scene_files import frames, look_at_origin, photo, write_blender, write_json
from keyss.core import InputError, KeyssWarning
from keyss.files import load_scene


def test_lego(real_data: Path) -> None:
    scene = load_scene(real_data / "lego", width=100)
    assert (scene.name, len(scene.train), len(scene.test)) == ("lego", 100, 25)
    assert scene.background.tolist() == [1, 1, 1]
    assert scene.points.shape == scene.colors.shape == (0, 3)
    for view in scene.views:
        camera = view.camera
        towards_origin = -camera.position / camera.position.norm()
        assert float(camera.viewmat[2, :3] @ towards_origin) > 0.999
        assert camera.viewmat[1, 2] < 1e-4  # the cameras stand on the upper hemisphere, upright
        focal = 50 / math.tan(0.6911112070083618 / 2)
        np.testing.assert_allclose(camera.K, [[focal, 0, 50], [0, focal, 50], [0, 0, 1]], rtol=1e-6)
        assert view.image[0, 0].tolist() == [255, 255, 255]
        assert view.image.float().mean() < 250  # there is something on the white
    assert scene.train[0].camera.name == "train/r_0.png"


def test_poses_in_opencv_axes(tmp_path: Path) -> None:
    camera = load_scene(write_blender(tmp_path)).train[0].camera
    assert camera.position.tolist() == pytest.approx([4, 0, 0], abs=1e-6)
    assert camera.viewmat[2, :3].tolist() == pytest.approx([-1, 0, 0], abs=1e-6)
    assert camera.viewmat[1, :3].tolist() == pytest.approx([0, 0, -1], abs=1e-6)
    assert camera.K[0, 0] == camera.K[1, 1] == pytest.approx(6 / math.tan(0.35))


@pytest.mark.parametrize("background", [None, (0.0, 0.5, 1.0), torch.tensor([0.2, 0.0, 0.4])])
def test_transparent_photos(tmp_path: Path, background: object) -> None:
    scene = load_scene(write_blender(tmp_path), background=background)  # type: ignore[arg-type]
    behind = np.array([1, 1, 1] if background is None else list(background), np.float64)
    rgba = photo(0, 4).astype(np.float64)
    alpha = rgba[:, :, 3:] / 255
    expected = rgba[:, :, :3] * alpha + 255 * behind * (1 - alpha)
    assert np.abs(scene.train[0].image.numpy() - expected).max() <= 0.51
    np.testing.assert_allclose(scene.background, behind, rtol=1e-6)


def write_transforms(folder: Path, matrix: object) -> None:
    meta = {"camera_angle_x": 0.7, "frames": frames(["train/r_0", "train/r_1"])}
    meta["frames"][0]["transform_matrix"] = matrix  # type: ignore[index]
    write_json(folder / "transforms_train.json", meta)


def changed(row: int, column: int, value: object) -> list[list[object]]:
    matrix: list[list[object]] = [list(r) for r in look_at_origin(0.0)]
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (None, r"Expected `array`, got `null`"),
        ([[1, 0, 0, 0]], r"Expected `array` of length >= 3"),
        ([[1, 0, 0]] * 4, r"Expected `array` of length 4, got 3 - at `\$\[0\]`"),
        ([1, 2, 3, 4], r"Expected `array`, got `int` - at `\$\[0\]`"),
        (changed(0, 0, "one"), r"Expected `float`, got `str` - at `\$\[0\]\[0\]`"),
        (changed(0, 3, math.nan), "finite `transform_matrix`, found NaN or"),
        (changed(3, 0, math.nan), "ends in 0 0 0 1"),
        (changed(0, 3, 10**400), "finite `transform_matrix`"),
        (changed(0, 3, 1e300), "finite `transform_matrix`"),
        (changed(0, 2, 1.1), "with a rotation"),
        (changed(0, 2, -1.0), "with a rotation"),  # a mirror
        ([[0, 0, 0, 1]] * 3, "with a rotation"),
    ],
)
def test_invalid_poses(tmp_path: Path, matrix: object, message: str) -> None:
    """By the photo, which can be left out."""
    write_transforms(write_blender(tmp_path), matrix)
    said = r"transforms_train.json: 1 of 2 photos have no usable camera"
    error = rf"frame 0 \(train/r_0.png\): .*{message}.*"
    with pytest.raises(InputError, match=f"{said}: {error}; `skip_missing=True` leaves them out"):
        load_scene(tmp_path)
    with pytest.warns(KeyssWarning, match=f"{said}, left out: {error}"):
        scene = load_scene(tmp_path, skip_missing=True)
    assert [view.camera.name for view in scene.train] == ["train/r_1.png"]


def test_scene_without_usable_cameras(tmp_path: Path) -> None:
    meta = {"camera_angle_x": math.nan, "frames": frames(["train/r_0", "train/r_1"])}
    write_json(write_blender(tmp_path) / "transforms_train.json", meta)
    with pytest.raises(InputError, match=r"frame 0 \(train/r_0.png\): .*camera_angle_x .*found nan$"):
        load_scene(tmp_path, skip_missing=True)


@pytest.mark.parametrize("angle", [0, -1, 3.2, "wide", None, 10**400, [0.7]])
def test_invalid_angles(tmp_path: Path, angle: object) -> None:
    path = write_blender(tmp_path) / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": angle}))
    with pytest.raises(InputError, match="camera_angle_x"):
        load_scene(tmp_path)
