"""COLMAP scenes: agreement with pycolmap, and refusal of broken files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from files.scene_files import camera_bytes, counted, image_bytes, photo, point_bytes, save, write_colmap
from keyss.core import InputError, KeyssWarning
from keyss.files import load_scene
from keyss.files.colmap import read_colmap

BINARIES = ("cameras.bin", "images.bin", "points3D.bin")


def as_text(binary: Path, text: Path) -> None:
    """COLMAP's own conversion of a model to .txt."""
    text.mkdir(parents=True, exist_ok=True)
    pycolmap.Reconstruction(binary).write_text(text)


def text_scene(folder: Path) -> Path:
    """Write a scene with a text model; returns the model's folder."""
    model = write_colmap(folder) / "sparse" / "0"
    as_text(model, model)
    for name in BINARIES:
        (model / name).unlink()
    return model


@pytest.mark.parametrize("model", ["sparse/0", "sparse", ".", "colmap/sparse/0"])
def test_model_locations(tmp_path: Path, model: str) -> None:
    scene = load_scene(write_colmap(tmp_path / "kitchen", model=model))
    assert scene.name == "kitchen"
    assert [v.camera.name for v in scene.test] == ["00.png"]
    assert [v.camera.name for v in scene.train] == ["01.png", "02.png"]
    assert scene.points.tolist() == [[-1, 0, 1], [1, 2, 3]]  # by id
    assert scene.colors.tolist() == [[255, 0, 9], [1, 2, 3]]
    assert scene.points.dtype == torch.float32
    assert scene.colors.dtype == torch.uint8
    assert scene.background.tolist() == [0, 0, 0]
    camera = scene.train[0].camera
    assert camera.K.tolist() == [[10, 0, 6], [0, 11, 4], [0, 0, 1]]
    assert (camera.width, camera.height) == (12, 8)
    assert np.array_equal(scene.train[0].image.numpy(), photo(1))


def test_agrees_with_pycolmap(real_data: Path, tmp_path: Path) -> None:
    reconstruction = pycolmap.Reconstruction(real_data / "fox" / "sparse" / "0")
    layout = read_colmap(real_data / "fox")
    by_name = {image.name: image for image in reconstruction.images.values()}
    assert {p.name for p in layout.train + layout.test} == by_name.keys()
    for taken in layout.train + layout.test:
        image = by_name[taken.name]
        np.testing.assert_allclose(taken.viewmat[:3], image.cam_from_world().matrix(), atol=1e-12)
        np.testing.assert_allclose(taken.lens.K, image.camera.calibration_matrix())
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    np.testing.assert_array_equal(layout.points.xyz, np.array([p.xyz for p in points]))
    np.testing.assert_array_equal(layout.points.rgb, [p.color for p in points])

    as_text(real_data / "fox" / "sparse" / "0", tmp_path / "fox" / "sparse" / "0")
    (tmp_path / "fox" / "images").symlink_to(real_data / "fox" / "images")
    text = read_colmap(tmp_path / "fox")
    np.testing.assert_array_equal(text.points.xyz, layout.points.xyz)
    np.testing.assert_array_equal(text.points.rgb, layout.points.rgb)
    for ours, theirs in zip(text.train + text.test, layout.train + layout.test, strict=True):
        assert (ours.name, ours.lens) == (theirs.name, theirs.lens)
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, atol=1e-12)


def test_text_models(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    model = folder / "sparse" / "0"
    for name in BINARIES:
        (model / name).unlink()
    save(folder / "images" / "left camera" / "1 a.png", photo(9))
    (model / "cameras.txt").write_text("# cameras\r\n1 SIMPLE_PINHOLE 12 8 10 6 4\r\n\r\n")
    images = "#\n\n1 2 0 0 0 0 0 4 1 left camera/1 a.png\n\n2 1 0 0 0 0 0 4 1 01.png\n1.0 2.0 -1\n"
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").write_text("5 1 2 3 4 5 6 0.1 1 0 2 0\n")
    scene = load_scene(folder)
    assert [v.camera.name for v in scene.views] == ["left camera/1 a.png", "01.png"]
    assert torch.equal(
        scene.train[0].camera.viewmat[:3, :3], torch.eye(3)
    )  # the quaternion was not normalised
    assert scene.points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_missing_points(tmp_path: Path, suffix: str) -> None:
    write = text_scene if suffix == ".txt" else write_colmap
    write(tmp_path / "scene")
    model = tmp_path / "scene" / "sparse" / "0"
    (model / f"points3D{suffix}").unlink()
    with pytest.warns(KeyssWarning, match=rf"points3D\{suffix}: there are no points; .* random points"):
        scene = load_scene(tmp_path / "scene")
    assert scene.points.shape == scene.colors.shape == (0, 3)
    assert len(scene.views) == 3


@pytest.mark.parametrize("name", BINARIES)
def test_truncated_files_are_refused(tmp_path: Path, name: str) -> None:
    path = write_colmap(tmp_path) / "sparse" / "0" / name
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=name):
            read_colmap(tmp_path)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match="end of the file"):
        read_colmap(tmp_path)


def second_image(name: str, **fields: Any) -> dict[str, bytes]:
    """Two images; the fields are of the second."""
    return {"images": counted(image_bytes(1, "00.png"), image_bytes(2, name, **fields))}


def one_camera(**fields: Any) -> dict[str, bytes]:
    """One camera with these fields."""
    return {"cameras": counted(camera_bytes(**fields))}


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        (second_image("01.png", quaternion=(0, 0, 0, 0)), "'01.png': expected a rotation.*skip_missing"),
        (second_image("01.png", quaternion=(math.nan, 0, 0, 1)), "expected a rotation"),
        (second_image("01.png", quaternion=(1e308,) * 4), "expected a rotation"),
        (second_image("01.png", translation=(0, math.inf, 0)), "finite translation"),
        (second_image("01.png", translation=(0, 1e300, 0)), "finite translation"),
        (second_image("01.png", camera_id=5), "camera 5, which does not exist"),
        (second_image("00.png"), "'00.png' twice"),
        (second_image("x" * 5000), "image name of up to 4095 bytes"),
        (second_image("missing.png"), r"1 of 2 photos are missing: missing\.png;"),
        (second_image("../images/01.png"), "inside images/"),
        (second_image("a\\..\\01.png"), "inside images/"),
        (second_image("/etc/passwd"), "inside images/"),
        (second_image("C:\\01.png"), "inside images/"),
        (second_image("a\nb"), "inside images/"),
        (second_image(""), "inside images/"),
        ({"images": counted(image_bytes(1, "00.png"))}, "at least 2 posed images"),
        ({"images": counted()}, "at least 2 posed images"),
        ({"cameras": counted(camera_bytes(), camera_bytes())}, "id 1 twice"),
        (one_camera(model=7, params=(1, 1, 6, 4, 0.1)), "camera model FOV is not supported"),
        (one_camera(model=-1), "camera model number -1 is not supported"),
        (one_camera(params=(-1, 1, 6, 4)), "focal lengths"),
        (one_camera(params=(math.nan, 1, 6, 4)), "focal lengths"),
        (one_camera(params=(9, 9, math.inf, 4)), "principal point"),
        (one_camera(model=2, params=(9, 6, 4, math.nan)), "coefficients.*k1=nan"),
        (one_camera(model=2, params=(9, 6, 4, -50)), "cannot be undone"),
        (one_camera(width=0), "found 0x8"),
        (one_camera(height=2**60), "image size"),
        ({"points3D": counted(point_bytes(1, (0, math.nan, 0)))}, "expected finite points"),
        ({"points3D": counted(point_bytes(1, (0, 1e200, 0)))}, "expected finite points"),
    ],
)
def test_invalid_values(tmp_path: Path, replaced: dict[str, bytes], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_scene(write_colmap(tmp_path, **replaced))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras.txt", "1 PINHOLE 12\n", "line 1: expected `CAMERA_ID MODEL"),
        ("cameras.txt", "1 PINHOLE 12 8 10 11 6\n", "expected 4 numbers, found 3"),
        ("cameras.txt", "1 PINHOLE 12 x 10 11 6 4\n", "expected a number .*'x'"),
        ("cameras.txt", "1 EUCM 12 8 10 11 6 4\n", "EUCM is not supported"),
        ("images.txt", "1 1 0 0 0 0 0 4 1\n", "line 1: expected `IMAGE_ID"),
        ("images.txt", "1 1 0 0 0 0 0 nan 1 00.png\n", "finite translation"),
        ("points3D.txt", "1 0 0 0\n", "line 1: expected `POINT3D_ID"),
        ("points3D.txt", "1 0 0 0 0 256 0 0.5\n", "colours of 0 to 255"),
        ("points3D.txt", "1 0 inf 0 0 0 0 0.5\n", "finite points"),
        ("points3D.txt", "1 0 0 0 0 0 0\n", "expected `POINT3D_ID"),
        ("points3D.txt", "1 0 0 0 0 0 blue 0\n", "expected a number .*'blue'"),
    ],
)
def test_broken_text_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (text_scene(tmp_path / "scene") / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_colmap(tmp_path / "scene")


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse"])
def test_largest_of_several_models_is_used(tmp_path: Path, place: str) -> None:
    write_colmap(tmp_path, 2, model=f"{place}/0")
    write_colmap(tmp_path, 5, model=f"{place}/1")
    write_colmap(tmp_path, 3, model=f"{place}/10")
    said = rf"there are 3 sparse models; using the one with most photos, {place}/1 \(5 photos\)"
    with pytest.warns(KeyssWarning, match=said):
        scene = load_scene(tmp_path)
    assert len(scene.views) == 5
    (tmp_path / place / "10" / "images.bin").write_bytes(b"\xff")  # the damage of another does not matter
    with pytest.warns(KeyssWarning, match=said):
        assert len(load_scene(tmp_path).views) == 5
