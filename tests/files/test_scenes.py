"""Properties of scenes in every layout: detection, photos, sizes, determinism."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import torch
from PIL import Image

from files.scene_files import (
    HEIGHT,
    WIDTH,
    camera_bytes,
    counted,
    frames,
    image_bytes,
    photo,
    save,
    write_blender,
    write_colmap,
    write_nerfstudio,
)
from keyss.core import InputError, KeyssWarning
from keyss.files import load_scene

WRITERS = {"colmap": write_colmap, "blender": write_blender, "nerfstudio": write_nerfstudio}


def around(folder: Path, colour: int, masked: bool = False) -> list[float]:
    """The background of a scene of random photos whose edges have `colour`, up to the noise of a JPEG."""
    write_colmap(folder)
    for index, path in enumerate(sorted((folder / "images").iterdir())):
        pixels = np.clip(photo(index) // 64 + colour - 2, 0, 255).astype(np.uint8)
        pixels[1:-1, 1:-1] = photo(index)[1:-1, 1:-1]
        if masked:
            pixels[0] = photo(index)[0]
            keep = np.full((HEIGHT, WIDTH), 255, np.uint8)
            keep[0] = 0
            save(folder / "masks" / path.name, keep)
        save(path, pixels)
    return [float(value) for value in load_scene(folder).background * 255]


@pytest.mark.parametrize("colour", [2, 128, 250])
def test_plain_backgrounds_are_found(tmp_path: Path, colour: int) -> None:
    assert around(tmp_path, colour) == pytest.approx([colour] * 3, abs=2)


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")  # of masks
def test_masked_edges_do_not_count(tmp_path: Path) -> None:
    assert around(tmp_path, 128, masked=True) == pytest.approx([128] * 3, abs=2)


def test_edges_of_many_colours_are_no_background(tmp_path: Path) -> None:
    assert load_scene(write_colmap(tmp_path)).background.tolist() == [0, 0, 0]


def test_every_eighth_photo_is_a_test_view(tmp_path: Path) -> None:
    images = counted(*(image_bytes(i, f"{i:02}.png") for i in reversed(range(20))))
    scene = load_scene(write_colmap(tmp_path, 20, images=images))
    assert [v.camera.name for v in scene.test] == ["00.png", "08.png", "16.png"]
    assert [v.camera.name for v in scene.train] == [f"{i:02}.png" for i in range(20) if i % 8]


@pytest.mark.filterwarnings("error")
def test_all_photos_from_one_point(tmp_path: Path) -> None:
    posed = frames([f"images/frame_{i:05}.png" for i in range(9)])
    for frame in posed:
        for row, x in zip(frame["transform_matrix"], (0.3, -1.2, 2.1), strict=False):
            row[3] = x
    assert not load_scene(write_nerfstudio(tmp_path, 9, frames=posed)).origin.any()


def test_unknown_layouts(tmp_path: Path) -> None:
    known = "Known layouts: COLMAP .*; Blender .*; Nerfstudio"
    with pytest.raises(InputError, match=f"found an empty folder.*{known}"):
        load_scene(tmp_path)
    (tmp_path / "video.mp4").touch()
    with pytest.raises(InputError, match=f"found video.mp4. {known}"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match=f"found an empty file. {known}"):
        load_scene(tmp_path / "video.mp4")
    (tmp_path / "video.mp4").write_bytes(b"\0\0\0\x20ftypisom")
    with pytest.raises(InputError, match=f"found a video; a scene is a folder of photos .*. {known}"):
        load_scene(tmp_path / "video.mp4")
    with pytest.raises(InputError, match=f"found nothing there. {known}"):
        load_scene(tmp_path / "none")


@pytest.mark.parametrize(
    ("width", "size"), [(6, (6, 4)), (5, (5, 3)), (1, (1, 1)), (12, (12, 8)), (100, (12, 8))]
)
def test_width_never_enlarges(tmp_path: Path, width: int, size: tuple[int, int]) -> None:
    write_colmap(tmp_path)
    full, view = load_scene(tmp_path).train[0], load_scene(tmp_path, width=width).train[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.image.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(view.camera.K[0], full.camera.K[0] * size[0] / 12)
    np.testing.assert_allclose(view.camera.K[1], full.camera.K[1] * size[1] / 8)


@pytest.mark.parametrize("width", [6, 5, 7, 1])
def test_downscaling_averages_areas(tmp_path: Path, width: int) -> None:
    view = load_scene(write_colmap(tmp_path), width=width).train[0]
    height = view.camera.height
    columns, rows = area_weights(WIDTH, width), area_weights(HEIGHT, height)
    expected = np.einsum("ih,jw,hwc->ijc", rows, columns, photo(1).astype(np.float64))
    assert np.abs(view.image.numpy() - expected).max() < 0.51


def area_weights(old: int, new: int) -> np.ndarray:
    """[new, old] the share of each old cell in each new one."""
    edges = np.arange(new + 1) * old / new
    left, right = edges[:-1, None], edges[1:, None]
    cells = np.arange(old)[None]
    return (np.minimum(right, cells + 1) - np.maximum(left, cells)).clip(0) * new / old


@pytest.mark.parametrize("size", [(18, 12), (6, 4), (17, 11), (30, 20)])
def test_intrinsics_are_scaled_to_the_photos(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    cameras = counted(camera_bytes(width=width, height=height, params=(40, 50, width / 2, height / 2)))
    folder = write_colmap(tmp_path, cameras=cameras)
    camera = load_scene(folder).train[0].camera
    assert (camera.width, camera.height) == (12, 8)
    expected = [[40 * 12 / width, 0, 6], [0, 50 * 8 / height, 4], [0, 0, 1]]
    np.testing.assert_allclose(camera.K, expected, rtol=1e-6)


def with_photo(folder: Path, image: Image.Image, **options: object) -> np.ndarray:
    """The pixels of a scene's training photo after `image` took its place."""
    write_colmap(folder)
    image.save(folder / "images" / "01.png", **options)  # type: ignore[arg-type]
    return load_scene(folder, background=(0, 0, 1)).train[0].image.numpy()


def test_image_modes_become_rgb(tmp_path: Path) -> None:
    grey = photo(3, 1)[:, :, 0]
    rgb = np.repeat(grey[:, :, None], 3, axis=2)
    assert np.array_equal(with_photo(tmp_path, Image.fromarray(grey)), rgb)
    deep = grey.astype(np.uint16) * 257
    assert np.array_equal(with_photo(tmp_path, Image.fromarray(deep)), rgb)
    palette = Image.fromarray(photo(4)).quantize(16)
    assert np.array_equal(with_photo(tmp_path, palette), np.asarray(palette.convert("RGB")))
    see_through = with_photo(tmp_path, palette, transparency=bytes([0] * 16))
    assert (see_through == [0, 0, 255]).all()
    one_bit = Image.fromarray(grey > 99)
    assert np.array_equal(with_photo(tmp_path, one_bit), np.where(rgb > 99, 255, 0))


@pytest.mark.parametrize("layout", WRITERS)
def test_missing_photos(tmp_path: Path, layout: str) -> None:
    WRITERS[layout](tmp_path, count=10)
    train = load_scene(tmp_path).train
    folder = tmp_path / "images" if layout == "colmap" else tmp_path
    for view in (train[0], train[-1]):
        (folder / view.camera.name).unlink()
    gone = [
        view.camera.name.removesuffix(".png" if layout == "blender" else "") for view in (train[0], train[-1])
    ]
    message = f"2 of 10 photos are missing: {gone[0]}, {gone[1]}; .*`skip_missing=True`"
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path)
    with pytest.warns(KeyssWarning, match=f"2 of 10 photos are missing, left out: {gone[0]}, {gone[1]}$"):
        left = load_scene(tmp_path, skip_missing=True)
    names = {view.camera.name for view in left.views}
    assert not names & {train[0].camera.name, train[-1].camera.name}
    assert len(left.train) + len(left.test) == (18 if layout == "blender" else 8)
    poses = {view.camera.name: view for view in train}
    for view in left.train:
        if view.camera.name in poses:
            assert torch.equal(view.camera.viewmat, poses[view.camera.name].camera.viewmat)
            assert torch.equal(view.image, poses[view.camera.name].image)


@pytest.mark.parametrize("layout", WRITERS)
def test_scene_without_photos(tmp_path: Path, layout: str) -> None:
    WRITERS[layout](tmp_path, count=7)
    for path in tmp_path.rglob("*.png"):
        path.unlink()
    for skip_missing in (False, True):  # nothing to advise: no photo would be left
        with pytest.raises(InputError, match=r"7 of 7 photos are missing: .* and 2 more$"):
            load_scene(tmp_path, skip_missing=skip_missing)


def test_broken_photos(tmp_path: Path) -> None:
    path = write_colmap(tmp_path) / "images" / "01.png"
    data = path.read_bytes()
    for length in range(0, len(data) - 20, 7):  # the last 20 bytes are checksums and the end mark
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"01\.png: expected an image"):
            load_scene(tmp_path)
    path.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 8\n")
    with pytest.raises(InputError, match=r"01\.png: expected an image \(JPEG, PNG.* must be converted$"):
        load_scene(tmp_path)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"01\.png: expected an image"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("side", "limit"), [(5_000, "24"), (9_500, "89"), (30_000, "89")])
def test_image_decompression_bombs(tmp_path: Path, side: int, limit: str) -> None:
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    folder = write_colmap(tmp_path, cameras=counted(camera_bytes(width=side, height=side)))
    (folder / "images" / "01.png").write_bytes(png)
    with pytest.raises(InputError, match=rf"01\.png: expected an image of at most {limit},000,000 pixels"):
        load_scene(folder)


def test_photos_that_exceed_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path, 10)
    pixels = 10 * WIDTH * HEIGHT * 3  # bytes
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=pixels - 1))
    with pytest.raises(InputError, match=rf"10 photos take .*`width={int(WIDTH * 0.5**0.5)}`"):
        load_scene(tmp_path)
    assert load_scene(tmp_path, width=int(WIDTH * 0.5**0.5)).train
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=pixels))
    assert load_scene(tmp_path).train
