"""Undistortion against pycolmap's camera models, to a hundredth of a pixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from files.scene_files import camera_bytes, counted, image_bytes, save, write_colmap
from keyss.core import InputError
from keyss.files import load_scene
from keyss.files.lens import Lens, make_lens, undistortion

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
def test_undistorted_photos_show_what_the_camera_model_says(
    tmp_path: Path, model: str, params: tuple[float, ...]
) -> None:
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


@pytest.mark.parametrize(("model", "params"), MODELS)
def test_no_more_is_cut_off_than_needed(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    _, folder = scene_with(tmp_path, model, params)
    K = load_scene(folder).train[0].camera.K
    zoom = float(K[0, 0]) / params[0]
    assert 1.0 <= zoom < 1.3
    assert K[0, 2] == pytest.approx(params[2 if params[1] > 100 or model == "OPENCV_FISHEYE" else 1])


def test_undistorting_comes_before_shrinking(tmp_path: Path) -> None:
    _, folder = scene_with(tmp_path, *MODELS[3])
    full, half = (load_scene(folder, width=width).train[0] for width in (None, W // 2))
    pairs = full.image.double().reshape(H // 2, 2, W // 2, 2, 3).mean(dim=(1, 3))
    assert (half.image.double() - pairs).abs().max() <= 0.51
    np.testing.assert_allclose(half.camera.K[:2], full.camera.K[:2] / 2)


def test_zero_coefficients_leave_the_photo_alone(tmp_path: Path) -> None:
    _, folder = scene_with(tmp_path, "OPENCV", (130, 140, 77, 63, 0, 0, 0, 0))
    view = load_scene(folder).train[0]
    assert view.camera.K.tolist() == [[130, 0, 77], [0, 140, 63], [0, 0, 1]]
    assert view.image[5, 7].tolist() == [7, 5, 0]


def test_strong_distortion_is_cut_down_to_where_it_is_unique() -> None:
    lens = make_lens("here", W, H, {"f": 60, "cx": 80, "cy": 60, "k1": -0.5})  # folds back inside the image
    straight = undistortion(lens, "here")
    corner = np.hypot(80, 60) / straight.pinhole.fx
    assert corner < 1.02 / np.sqrt(1.5)  # where r - r^3 / 2 turns back, to a cell of the search grid
    assert corner > 0.9 / np.sqrt(1.5)


def test_distortion_that_cannot_be_undone_is_refused() -> None:
    lens = make_lens("here", W, H, {"f": 5, "cx": 80, "cy": 60, "k1": -100})
    with pytest.raises(InputError, match=r"here: the lens distortion .* cannot be undone"):
        undistortion(lens, "here")


@pytest.mark.parametrize(
    ("size", "fits"),
    [
        ((4946, 3286), True),
        ((2473, 1643), True),
        ((1237, 822), True),  # images_4 of Mip-NeRF 360, rounded up
        ((1236, 821), True),
        ((618, 411), True),
        ((3286, 4946), False),
        ((2473, 1640), False),
        ((4000, 2657), True),  # 2657.5 rounded down
        ((4000, 2659), False),
        ((9892, 6572), True),
    ],
)
def test_which_image_sizes_belong_to_a_camera(size: tuple[int, int], fits: bool) -> None:
    lens = Lens(4946, 3286, 4000.0, 4000.0, 2473.0, 1643.0, (0.1,) * 8).on_image(*size)
    assert (lens is not None) == fits
    if lens is not None:
        assert (lens.width, lens.height) == size
        assert lens.cx == pytest.approx(size[0] / 2)
        assert lens.distortion == (0.1,) * 8
