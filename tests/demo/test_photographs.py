"""The demo scenes: what they promise on disk, and that images, poses and points belong together."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from keyss.core import OutputError, Scene, UsageError
from keyss.core.alignment import focus_point, up_direction
from keyss.demo.photographs import DEMO_SCENES, write_demo_scene
from keyss.files.scenes import load_scene


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module", params=DEMO_SCENES)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demo") / request.param
    write_demo_scene(path, request.param, views=16, width=96, height=72)
    return path


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder)


def test_loads_as_a_scene(scene: Scene) -> None:
    assert (len(scene.train), len(scene.test)) == (14, 2)
    assert {tuple(view.image.shape) for view in scene.views} == {(72, 96, 3)}
    assert scene.points.shape == (3000, 3)
    assert scene.colors.shape == (3000, 3)


def test_cameras_look_at_the_middle_from_all_around(scene: Scene) -> None:
    cameras = [view.camera for view in scene.views]
    assert focus_point(cameras).norm() < 0.8
    up = up_direction(cameras)
    assert up is not None
    assert up[2] > 0.99
    angles = sorted(math.atan2(*camera.position[:2].flip(0).tolist()) for camera in cameras)
    assert np.diff([*angles, angles[0] + 2 * math.pi]).max() < 0.7
    assert len({round(float(camera.position[2]), 1) for camera in cameras}) >= 3


def test_points_and_poses_agree_with_the_images(scene: Scene) -> None:
    """Where a point is seen, its colour is; occluded points are outvoted."""
    matched, shuffled = [], []
    for view in scene.views:
        camera = view.camera
        seen = scene.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = seen @ camera.K.T
        columns, rows = (pixels[:, i].div(pixels[:, 2]).floor().long() for i in (0, 1))
        inside = (seen[:, 2] > 0) & (columns >= 0) & (columns < 96) & (rows >= 0) & (rows < 72)
        assert inside.sum() > 1000
        shown, expected = view.image[rows[inside], columns[inside]].float(), scene.colors[inside].float()
        matched.append(float((shown - expected).abs().mean(dim=1).median()))
        shuffled.append(float((shown - expected.flip(0)).abs().mean(dim=1).median()))
    assert np.mean(matched) < 20
    assert np.mean(matched) < 0.4 * np.mean(shuffled)


def test_images_are_worth_looking_at(scene: Scene) -> None:
    """Neither washed out nor noise: wide contrast, many colours, and neighbours mostly alike."""
    images = np.stack([view.image.numpy() for view in scene.views]).astype(np.float32)
    low, high = np.percentile(images, [2, 98])
    assert high - low > 130
    assert np.mean((images > 2) & (images < 253)) > 0.95
    assert len(np.unique((images // 32).reshape(-1, 3), axis=0)) > 40
    assert np.median(np.abs(np.diff(images, axis=2))) < 6


def test_scenes_differ_in_every_view(tmp_path: Path) -> None:
    views = {}
    for which in DEMO_SCENES:
        write_demo_scene(tmp_path / which, which, views=8, width=32, height=24)
        views[which] = np.stack(
            [
                np.asarray(Image.open(path), dtype=float)
                for path in sorted((tmp_path / which).glob("images/*"))
            ]
        )
    first, second = views.values()
    assert np.sqrt(((first - second) ** 2).mean(axis=(1, 2, 3))).min() > 40


def test_one_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_demo_scene(tmp_path / name, "tea-table", views=8, width=32, height=24, seed=seed)
    first, again, other = (tree(tmp_path / name) for name in "abc")
    assert first == again
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first)


def test_layout(folder: Path) -> None:
    names = [f"images/{i:04d}.png" for i in range(16)]
    assert list(tree(folder)) == [*names, "points.ply", "transforms.json"]
    meta = json.loads((folder / "transforms.json").read_text())
    assert (meta["w"], meta["h"], meta["cx"], meta["cy"]) == (96, 72, 48, 36)
    assert meta["fl_x"] == meta["fl_y"] > 96
    assert [frame["file_path"] for frame in meta["frames"]] == names
    with Image.open(folder / names[0]) as image:
        assert (image.mode, image.size) == ("RGB", (96, 72))


def test_reports_progress(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    write_demo_scene(
        tmp_path / "a",
        "golden-knot",
        views=8,
        width=16,
        height=16,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (8, 8)


def test_writes_into_an_empty_folder_and_no_other(tmp_path: Path) -> None:
    def write(path: Path) -> None:
        write_demo_scene(path, "golden-knot", views=8, width=16, height=16)

    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty")
    with pytest.raises(OutputError, match="exists"):
        write(tmp_path / "empty")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="exists"):
        write(tmp_path / "file")
    with pytest.raises(OutputError, match="cannot create"):
        write(tmp_path / "file" / "below")


def test_nothing_is_left_of_an_interrupted_run(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_demo_scene(tmp_path / "a", "tea-table", views=8, width=16, height=16, progress=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("which", "options", "message"),
    [
        ("tea", {}, "tea-table, golden-knot, got 'tea'"),
        ("tea-table", {"views": 7}, "at least 8 views"),
        ("tea-table", {"width": 8}, "16 x 16"),
        ("tea-table", {"seed": -1}, "seed of 0 or more"),
    ],
)
def test_bad_arguments(tmp_path: Path, which: str, options: dict[str, int], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        write_demo_scene(tmp_path / "a", which, **options)
