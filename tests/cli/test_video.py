"""Videos, decoded again by OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch

import keyss as library
from cli.harness import Run, assert_refused
from files.scene_files import write_nerfstudio
from keyss import write_model
from keyss.core import Camera, Gaussians
from keyss.rendering import circle, middle_and_radius, render
from tiny_scenes import random_gaussians

Frames = list[npt.NDArray[np.uint8]]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models `a.ply` and `b.ply`, and a scene `scene`."""
    folder = tmp_path_factory.mktemp("films")
    for seed, name in enumerate("ab"):
        write_model(folder / f"{name}.ply", random_gaussians(400, seed))
    write_nerfstudio(folder / "scene", count=4)
    return folder


def frames_of(path: Path) -> Frames:
    film = cv2.VideoCapture(str(path))
    found = []
    while (read := film.read())[0]:
        found.append(np.ascontiguousarray(read[1][:, :, ::-1]))
    assert film.get(cv2.CAP_PROP_FPS) == 25
    return found


def render_uint8(model: Gaussians, camera: Camera) -> npt.NDArray[np.uint8]:
    with torch.no_grad():
        return (render(model, camera).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def psnr(a: npt.NDArray[np.uint8], b: npt.NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(((a / 255.0 - b / 255.0) ** 2).mean() + 1e-12))


def test_orbit(keyss: Run, files: Path, tmp_path: Path) -> None:
    result = keyss("render", files / "a.ply", "--video", tmp_path / "a.mp4", "--seconds", 0.4, "--width", 97)
    assert (result.status, result.out) == (0, f"{tmp_path / 'a.mp4'}: 10 frames\n")
    frames = frames_of(tmp_path / "a.mp4")
    assert [frame.shape for frame in frames] == [(96, 96, 3)] * 10
    model = random_gaussians(400, 0)
    expected = [render_uint8(model, camera) for camera in circle(model, 96, 10)]
    assert min(map(psnr, frames, expected)) > 30
    assert psnr(frames[0], expected[5]) < 25  # the camera moves


def test_circle_cameras() -> None:
    model = random_gaussians(50)
    middle, _ = middle_and_radius(model)
    for camera in circle(model, 32, 7):
        at = camera.viewmat[:3, :3] @ middle + camera.viewmat[:3, 3]
        torch.testing.assert_close(at[:2], torch.zeros(2), atol=1e-5, rtol=0)
        assert at[2] > 0
        assert camera.position[1] < middle[1]  # up is -y


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (("--video", "film.avi"), 2, "ends in .mp4"),
        (("--video", "film.mp4", "-o", "x"), 2, "leave out -o"),
        (("--video", "film.mp4", "--seconds", "0"), 2, "--seconds: expected more than 0"),
        (("--video", "film.mp4", "--seconds", "nan"), 2, "--seconds"),
        (("--video", "film.mp4", "--seconds", "1e9"), 2, "at most 600"),
        (("--video", "film.mp4", "--width", "1"), 2, "--width: expected 2"),
        (("--video", "film.mp4", "--wipe", "none.ply"), 4, "none.ply"),
        (("--video", "there.mp4"), 5, "--overwrite"),
        (("--wipe", "b.ply", "--cameras", "scene", "-o", "x"), 2, "give --video"),
        (("-o", "x"), 2, "--cameras SCENE"),
        ((), 2, "--video FILE"),
    ],
)
def test_invalid_arguments(
    keyss: Run,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    status: int,
    words: str,
) -> None:
    monkeypatch.chdir(files)
    (files / "there.mp4").write_bytes(b"mine")
    assert_refused(keyss("render", "a.ply", *arguments), status, words)
    assert (files / "there.mp4").read_bytes() == b"mine"
    assert not (files / "film.mp4").exists()


def test_interrupt_leaves_no_file(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("keyss.api.render.render_view", interrupted)
    with pytest.raises(KeyboardInterrupt):
        library.render(files / "a.ply", video=tmp_path / "a.mp4", width=32)
    assert list(tmp_path.iterdir()) == []
