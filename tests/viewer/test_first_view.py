"""The first picture of the page: the first test photo of a run, the subject of any other model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from files.scene_files import save, write_nerfstudio
from keyss.core import Camera, Gaussians, camera_positions
from keyss.files import load_scene, write_model
from keyss.rendering import frame_of
from keyss.viewer import export_html, look_of_scene, pose_of
from rendering.test_framing import FLOORS, fog, on_a_floor
from tiny_scenes import ring_cameras
from viewer.browser import HEIGHT, PROGRAM, WIDTH, Visit, camera_at


def turned(camera: Camera, quarters: int) -> Camera:
    """The camera, rolled about its viewing direction, as if a phone had been held on its side."""
    angle = quarters * math.pi / 2
    c, s = math.cos(angle), math.sin(angle)
    roll = torch.tensor([[c, s, 0, 0], [-s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return replace(camera, viewmat=roll @ camera.viewmat)


@pytest.mark.parametrize("quarters", [0, 1, 3])
@pytest.mark.parametrize("window", [(940, 800), (390, 600), (1600, 300)])
def test_photo_is_whole_and_upright(quarters: int, window: tuple[int, int]) -> None:
    """Also of a capture whose photos all lie on their side."""
    cameras = [turned(each, quarters) for each in ring_cameras(16)]
    shown = camera_at(pose_of(cameras[3], cameras), *window)
    assert -shown.viewmat[1, 2] > 0.9  # z is up in the scene
    torch.testing.assert_close(shown.position, cameras[3].position, atol=1e-4, rtol=0)
    pixels = torch.tensor([[x, y, 1.0] for x in (0, cameras[3].width) for y in (0, cameras[3].height)])
    rays = pixels @ torch.linalg.inv(cameras[3].K).T @ cameras[3].viewmat[:3, :3]
    seen = rays @ shown.viewmat[:3, :3].T @ shown.K.T
    places = seen[:, :2] / seen[:, 2:] / torch.tensor([float(each) for each in window])
    assert (places > -1e-3).all()
    assert (places < 1.001).all()
    assert float((places.amax(0) - places.amin(0)).max()) > 0.99  # as large as it fits


def test_first_test_photo(folders: tuple[Path, Path]) -> None:
    scene = load_scene(folders[0])
    first = min(scene.test, key=lambda view: view.camera.name)
    shown = camera_at(look_of_scene(folders[0])["pose"], 400, 300)
    torch.testing.assert_close(shown.position, first.camera.position, atol=1e-4, rtol=0)
    torch.testing.assert_close(shown.viewmat[2, :3], first.camera.viewmat[2, :3], atol=1e-4, rtol=0)
    assert torch.cdist(shown.position[None], camera_positions([v.camera for v in scene.train])).min() > 0.1


def test_background_of_the_photos(tmp_path: Path) -> None:
    scene = write_nerfstudio(tmp_path)
    assert look_of_scene(scene)["background"] == "#000000"
    for path in (scene / "images").iterdir():
        save(path, np.full((8, 12, 3), (255, 0, 128), np.uint8))
    assert look_of_scene(scene)["background"] == "#ff0080"
    assert look_of_scene(scene, (0.2, 1, 0))["background"] == "#33ff00"


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on PATH")
@pytest.mark.parametrize("up", ["-y", "z", "tilted"])
def test_subject_fills_the_page(tab: Visit, up: str, tmp_path: Path) -> None:
    """Fog around a model decides neither framing nor direction; up and middle are those of `frame_of`."""
    subject = on_a_floor(FLOORS[up])
    model = Gaussians.cat([subject, fog()])
    write_model(tmp_path / "model.ply", model)
    (page,) = export_html(tmp_path / "model.ply", tmp_path / "page.html")
    tab.goto(page.as_uri())
    tab.page.wait_for_function("() => location.hash !== ''")
    shown, frame = camera_at(tab.page.url.partition("#")[2], WIDTH, HEIGHT), frame_of(model)
    assert float(-shown.viewmat[1, :3] @ torch.from_numpy(frame.up).float()) > 0.9
    seen = (subject.means @ shown.viewmat[:3, :3].T + shown.viewmat[:3, 3]) @ shown.K.T
    places = seen[:, :2] / seen[:, 2:] / torch.tensor([WIDTH, HEIGHT])
    inside = ((places > 0) & (places < 1)).all(1) & (seen[:, 2] > 0)
    assert inside.float().mean() > 0.85
    assert float((places.quantile(0.95, 0) - places.quantile(0.05, 0)).max()) > 0.5
