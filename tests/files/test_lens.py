"""Undistortion against pycolmap's camera models, to a hundredth of a pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from files.scene_files import camera_bytes, counted, image_bytes, save, write_colmap
from keyss.files import load_scene

W, H = 160, 120
MODELS = [
    ("SIMPLE_RADIAL", (130, 82, 57, -0.12)),
    ("SIMPLE_RADIAL", (130, 82, 57, 0.15)),
    ("RADIAL", (130, 80, 60, 0.1, -0.03)),
    ("OPENCV", (130, 140, 77, 63, 0.08, -0.05, 0.004, -0.006)),
    ("OPENCV", (130, 140, 77, 63, -0.2, 0.05, 0.002, 0.001)),
    ("OPENCV_FISHEYE", (70, 72, 79, 61, 0.03, -0.02, 0.004, -0.001)),
    ("FULL_OPENCV", (130, 140, 77, 63, 0.3, 0.05, 0.001, -0.002, 0.01, 0.25, 0.02, 0.003)),
    ("SIMPLE_RADIAL_FISHEYE", (70, 79, 61, 0.02)),
    ("RADIAL_FISHEYE", (70, 79, 61, 0.02, -0.01)),
]


def scene_with(folder: Path, model: str, params: tuple[float, ...]) -> tuple[pycolmap.Camera, Path]:
    """A scene of two photos whose red is the column and whose green is the row of every pixel."""
    camera = pycolmap.Camera(model=model, width=W, height=H, params=params)
    columns, rows = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    pixels = np.stack([columns, rows, np.zeros_like(rows)], axis=2).astype(np.uint8)  # rounded down by 0.5
    number = int(getattr(pycolmap.CameraModelId, model))
    cameras = counted(camera_bytes(model=number, params=params, width=W, height=H))
    write_colmap(folder, cameras=cameras, images=counted(image_bytes(1, "00.png"), image_bytes(2, "01.png")))
    for name in ("00.png", "01.png"):
        save(folder / "images" / name, pixels)
    return camera, folder


@pytest.mark.parametrize(("model", "params"), MODELS)
def test_undistortion_matches_pycolmap(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    oracle, folder = scene_with(tmp_path, model, params)
    view = load_scene(folder).train[0]
    K = view.camera.K.double().numpy()
    assert (view.camera.width, view.camera.height) == (W, H)
    columns, rows = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 3) @ np.linalg.inv(K).T
    expected = oracle.img_from_cam(rays).reshape(H, W, 2)
    assert expected.min() > -0.1  # nothing is made up beyond the photo's edges
    assert (expected < np.array([W, H]) + 0.1).all()
    found = view.image.double().numpy()[:, :, :2] + 0.5
    error = (found - expected)[2:-2, 2:-2]
    assert abs(error.mean()) < 0.02  # half a pixel anywhere would show here
    assert np.abs(error).max() < 0.6  # bytes are whole


def test_zero_distortion_keeps_the_photo(tmp_path: Path) -> None:
    _, folder = scene_with(tmp_path, "OPENCV", (130, 140, 77, 63, 0, 0, 0, 0))
    view = load_scene(folder).train[0]
    assert view.camera.K.tolist() == [[130, 0, 77], [0, 140, 63], [0, 0, 1]]
    assert view.image[5, 7].tolist() == [7, 5, 0]
