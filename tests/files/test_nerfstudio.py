"""Scenes in Nerfstudio's layout."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from files.scene_files import frames, photo, write_json, write_nerfstudio
from files.test_ply import ply_bytes
from keyss.core import InputError
from keyss.files import load_scene
from keyss.files.lens import undistortion
from keyss.files.transforms import read_nerfstudio, read_point_cloud

FRAMES = [f"images/frame_{i:05}.png" for i in range(10)]


def test_frame_intrinsics_override_the_file(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path / "desk")
    meta = json.loads((tmp_path / "desk" / "transforms.json").read_text())
    meta["frames"][1] |= {"fl_x": 20, "cx": 5.0, "w": 12.0}
    write_json(tmp_path / "desk" / "transforms.json", meta)
    scene = load_scene(tmp_path / "desk")
    assert scene.name == "desk"
    assert [v.camera.name for v in scene.test] == ["images/frame_00000.png"]
    assert scene.train[0].camera.K.tolist() == [[20, 0, 5], [0, 11, 4], [0, 0, 1]]
    assert scene.train[1].camera.K.tolist() == [[10, 0, 6.5], [0, 11, 4], [0, 0, 1]]
    assert np.array_equal(scene.train[1].image.numpy(), photo(2))
    assert scene.test[0].camera.position.tolist() == pytest.approx([4, 0, 0], abs=1e-6)
    assert scene.test[0].camera.viewmat[2, :3].tolist() == pytest.approx([-1, 0, 0], abs=1e-6)


def test_intrinsics_from_angles_and_photos(tmp_path: Path) -> None:
    angle = 2 * np.arctan(0.5)
    cut = {"w": None, "h": None, "fl_x": None, "fl_y": None, "cx": None, "cy": None}
    for angles, fl_y in (({}, 12), ({"camera_angle_y": angle}, 8)):
        scene = load_scene(write_nerfstudio(tmp_path, camera_angle_x=angle, **angles, **cut))
        np.testing.assert_allclose(scene.train[0].camera.K, [[12, 0, 6], [0, fl_y, 4], [0, 0, 1]], rtol=1e-6)


@pytest.mark.parametrize(
    ("keys", "model", "params"),
    [
        ({"k1": 0.1, "k2": -0.05, "p1": 0.004, "p2": -0.006}, "OPENCV", [0.1, -0.05, 0.004, -0.006]),
        ({"camera_model": "SIMPLE_RADIAL", "k1": -0.1}, "OPENCV", [-0.1, 0, 0, 0]),
        ({"k1": 0.1, "k2": -0.05, "k3": 0.02}, "FULL_OPENCV", [0.1, -0.05, 0, 0, 0.02, 0, 0, 0]),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.03, "k2": -0.02, "k3": 0.004, "k4": -0.001},
            "OPENCV_FISHEYE",
            [0.03, -0.02, 0.004, -0.001],
        ),
        ({"is_fisheye": True, "k1": 0.03}, "OPENCV_FISHEYE", [0.03, 0, 0, 0]),
    ],
)
def test_distortion_matches_colmap(
    tmp_path: Path, keys: dict[str, object], model: str, params: list[float]
) -> None:
    lens = read_nerfstudio(write_nerfstudio(tmp_path, **keys)).train[0].lens
    oracle = pycolmap.Camera(model=model, width=12, height=8, params=[10, 11, 6.5, 4, *params])
    straight = undistortion(lens, "here")
    columns, rows = np.meshgrid(np.arange(12) + 0.5, np.arange(8) + 0.5)
    rays = (
        np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 3)
        @ np.linalg.inv(straight.pinhole.K).T
    )
    ours = np.stack([straight.map_x, straight.map_y], axis=2) + 0.5
    np.testing.assert_allclose(ours.reshape(-1, 2), oracle.img_from_cam(rays), atol=1e-4)


def names(folder: Path) -> tuple[list[str], list[str]]:
    layout = read_nerfstudio(folder)
    return [p.name[-5] for p in layout.train], [p.name[-5] for p in layout.test]  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"train_filenames": FRAMES[0]}, r"Expected `array.*`, got `str` - at `\$\.train_filenames`"),
        ({"train_filenames": [3]}, r"Expected `str`, got `int` - at `\$\.train_filenames\[0\]`"),
        (
            {"train_filenames": ["images/none.png"]},
            "expected lists of frames, found 'images/none.png', which",
        ),
        ({"train_filenames": FRAMES[:1], "test_filenames": FRAMES[:1]}, f"found '{FRAMES[0]}' in both"),
        ({"test_filenames": FRAMES[:3]}, "at least one image to train on"),
        ({"camera_model": "EQUIRECTANGULAR"}, "'EQUIRECTANGULAR' is not supported"),
        ({"camera_model": 5}, r"Expected `str.*`, got `int` - at `\$\.camera_model`"),
        ({"camera_model": ["OPENCV"]}, r"Expected `str.*`, got `array` - at `\$\.camera_model`"),
        ({"k4": 0.1}, "expected k4 = 0"),
        ({"w": math.nan}, "whole numbers as `w` and `h`, found nan, 8"),
        ({"cx": math.inf}, "principal point"),
        ({"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, "a fisheye lens has no coefficients k5"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "a fisheye lens has no coefficients p1"),
        ({"fl_x": None, "fl_y": None}, "expected `fl_x` or `camera_angle_x`, found neither"),
        ({"fl_x": -10}, "focal lengths"),
        ({"w": 12.5}, "whole numbers as `w` and `h`, found 12.5, 8"),
        ({"w": "12"}, r"Expected `float.*`, got `str` - at `\$\.w`"),
        ({"h": 0}, "image size"),
        ({"h": 9}, "found 12x8"),
        ({"frames": []}, "expected posed frames, found none"),
        ({"frames": {"a": 1}}, r"Expected `array`, got `object` - at `\$\.frames`"),
        ({"frames": None}, "missing required field `frames`"),
        ({"frames": [1]}, r"Expected `object`, got `int` - at `\$\.frames\[0\]`"),
        ({"ply_file_path": 3}, r"Expected `str.*`, got `int` - at `\$\.ply_file_path`"),
        ({"ply_file_path": "none.ply"}, "none.ply: expected a file, found nothing"),
    ],
)
def test_invalid_fields(tmp_path: Path, extra: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_scene(write_nerfstudio(tmp_path, **extra))


@pytest.mark.parametrize(
    "file_path",
    ["/etc/hostname", "../../x.png", "images/../../../x.png", "C:/x.png", "..\\..\\x.png", "a\0b", "..", ""],
)
def test_paths_outside_of_the_scene(tmp_path: Path, file_path: str) -> None:
    with pytest.raises(InputError, match="expected paths in the scene's folder or its parent"):
        load_scene(write_nerfstudio(tmp_path, frames=frames(["images/frame_00000.png", file_path])))


@pytest.mark.parametrize("start", ["/home/somebody/scenes/garden/", "C:\\data\\garden\\"])
def test_absolute_paths_from_another_computer(tmp_path: Path, start: str) -> None:
    paths = [f"images/frame_{index:05}.png" for index in range(3)]
    write_nerfstudio(tmp_path, frames=frames([start + path for path in paths]))
    assert sorted(view.camera.name for view in load_scene(tmp_path).views) == paths


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", "null", "[" * 100_000, '{"frames": ' + "9" * 5000 + "}", "\xff"]
)
def test_invalid_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"transforms\.json: expected"):
        load_scene(tmp_path)


def replacements(value: Any, put: Any) -> Iterator[None]:
    """Replace every value inside a JSON value by junk, one at a time; `put` sets the root."""
    for junk in (None, True, -1, 1e308, float("nan"), "x", [], {}, [[]], {"a": 1}):
        put(junk)
        yield
    put(value)
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield from replacements(value[key], lambda new, at=key: value.__setitem__(at, new))


def test_junk_values_are_refused_or_ignored(tmp_path: Path) -> None:
    write_nerfstudio(
        tmp_path, 2, k1=0.01, applied_transform=[[1, 0, 0, 0]], train_filenames=["images/frame_00000.png"]
    )
    root = {"": copy.deepcopy(json.loads((tmp_path / "transforms.json").read_text()))}
    outcomes = set()
    for _ in replacements(root[""], lambda new: root.__setitem__("", new)):
        write_json(tmp_path / "transforms.json", root[""])
        try:
            load_scene(tmp_path)
            outcomes.add("read")
        except InputError:
            outcomes.add("refused")
    assert outcomes == {"refused", "read"}


XYZ = np.array([[0, 1, 2], [3, 4, 5.5], [-1, 0, 7]], np.float32)
RGB = np.array([[1, 2, 3], [255, 0, 128], [9, 9, 9]], np.uint8)


def cloud(kind: str) -> bytes:
    """The points, an unknown property, and an element of lists after them."""
    columns = dict(zip("xyz", XYZ.T, strict=True)) | {"extra": np.full(3, 0.25)}
    columns |= dict(zip(("red", "green", "blue"), RGB.T, strict=True))
    types = dict.fromkeys(("red", "green", "blue"), "uchar") | {"extra": "double"}
    faces = b"element face 0\nproperty list uchar int vertex_index\nend_header"
    return ply_bytes(columns, form=kind, kinds=types).replace(b"end_header", faces)


KINDS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("kind", KINDS)
def test_points_from_ply(tmp_path: Path, kind: str) -> None:
    write_nerfstudio(tmp_path, ply_file_path="sparse_pc.ply")
    (tmp_path / "sparse_pc.ply").write_bytes(cloud(kind))
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, XYZ)
    np.testing.assert_array_equal(scene.colors, RGB)


def test_points_match_colmaps_export(real_data: Path, tmp_path: Path) -> None:
    reconstruction = pycolmap.Reconstruction(real_data / "fox" / "sparse" / "0")
    reconstruction.export_PLY(tmp_path / "fox.ply")
    points = read_point_cloud(tmp_path / "fox.ply")
    expected = np.array([[*p.xyz.astype(np.float32), *p.color] for p in reconstruction.points3D.values()])
    found = np.concatenate([points.xyz, points.rgb], axis=1)
    np.testing.assert_array_equal(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])
