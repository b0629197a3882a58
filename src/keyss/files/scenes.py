"""Reads scenes of all layouts, with their photos decoded."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Doubles, Floats
from keyss.core.errors import InputError, KeyssWarning, UsageError
from keyss.core.scene import NEAR, ORDINARY_EXTENT, Camera, Scene, View, checked_background
from keyss.files.colmap import MODEL_PLACES, colmap_model_folder, read_colmap
from keyss.files.foreign import what_it_is
from keyss.files.images import is_turned, probe_image, read_image, read_mask, shrink
from keyss.files.lens import Lens, Undistortion, undistortion
from keyss.files.scene_layout import Photo, SceneLayout
from keyss.files.trained import kind_of_folder
from keyss.files.transforms import read_blender, read_nerfstudio

_FAR = 1000  # extents from the origin: single precision has ten thousandths of one left
_KNOWN = (
    "COLMAP (sparse/0/cameras.bin or .txt, images/); Blender / NeRF-synthetic (transforms_train.json); "
    "Nerfstudio (transforms.json). COLMAP (`colmap automatic_reconstructor`) and Nerfstudio "
    "(`ns-process-data images`) find the cameras of photos"
)


def load_scene(
    path: str | os.PathLike[str],
    *,
    width: int | None = None,
    background: Tensor | Sequence[float] | None = None,
    skip_missing: bool = False,
) -> Scene:
    """Read a scene folder in the layout of COLMAP, NeRF-synthetic or Nerfstudio, detected by content.

    `width`: wider photos are undistorted and then shrunk to this many pixels by area averaging, with K scaled
    per axis; photos are never enlarged.
    `background`: three numbers in [0, 1], behind everything and under transparent pixels; by default white
    if any photo has an alpha channel, else black.
    `skip_missing`: photos that are missing on disk, or whose camera is unusable, are left out, with a
    KeyssWarning, before test views are chosen.

    A scene whose place is over a thousand times as far from the origin as its cameras from each other, as
    georeferenced ones are, is moved there, with a KeyssWarning: see `Scene.origin`.

    The test views are those of the layout's split if it has one, else every 8th image by name. Camera names
    are the layout's image paths, relative to `images/` for COLMAP and to the scene's folder for the others
    (`train/r_0.png`). If COLMAP's `images/` is missing, the largest of `images_2/`, `images_4/` and
    `images_8/` is used. A scene may lack points, with a KeyssWarning for COLMAP; see
    `keyss.fitting.parameters.initial_points`. Rotations are orthonormal up to float32.

    Pixels that masks leave out (`mask_path` in transforms.json; `masks/` beside COLMAP's `images/`) do not
    count, with a KeyssWarning: see `View.mask`. Nor does a resampled pixel that has a part of such a one.

    Raises InputError for an unknown layout, broken or truncated files, missing or undecodable images, images
    whose aspect contradicts their camera's (by more than a pixel), or fewer than one training
    and one test image. Raises UsageError for a `width` or `background` out of range.
    """
    if width is not None and width < 1:
        raise UsageError(f"expected a width of at least 1 pixel, got {width}")
    behind = None if background is None else checked_background(background)
    folder = Path(path)
    layout = read_layout(folder, skip_missing)
    for part, purpose in ((layout.train, "to train on"), (layout.test, "to test on")):
        if not part:
            raise InputError(f"{folder}: expected at least one image {purpose}, found none")

    origin, extent = _place([photo.viewmat for photo in layout.train])
    if origin.any():
        where = ", ".join(f"{each:.9g}" for each in origin)
        warnings.warn(
            f"{folder}: too far from the origin for single precision: the scene and its models are moved by "
            f"minus ({where})",
            KeyssWarning,
            stacklevel=2,
        )
    near = NEAR * min(1.0, extent / ORDINARY_EXTENT)
    photos = [replace(each, viewmat=_moved(each.viewmat, origin)) for each in layout.train + layout.test]
    probed = [probe_image(photo.path) for photo in photos]  # all, to find missing photos now
    photos = _on_images(folder, photos, [(width, height) for width, height, _ in probed])
    if behind is None:
        behind = torch.full((3,), float(any(transparent for *_, transparent in probed)))
    # Most scenes have one lens, and a map is as large as a photo, so only the last two are cached.
    undistortions = functools.lru_cache(maxsize=2)(undistortion)
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        decode = functools.partial(
            _view, width=width, background=behind.numpy(), undistortions=undistortions, near=near
        )
        views = tuple(pool.map(decode, photos))
    if shares := [float((~view.mask).float().mean()) for view in views if view.mask is not None]:
        warnings.warn(
            f"{folder}: {len(shares):,} of {len(views):,} photos have masks, which leave "
            f"{sum(shares) / len(shares):.0%} of their pixels out of training and measures",
            KeyssWarning,
            stacklevel=2,
        )
    return Scene(
        name=folder.resolve().name,
        train=views[: len(layout.train)],
        test=views[len(layout.train) :],
        points=torch.from_numpy((layout.points.xyz - origin).astype(np.float32)),
        colors=torch.from_numpy(layout.points.rgb),
        background=behind,
        origin=torch.from_numpy(origin),
    )


def _place(viewmats: Sequence[Doubles]) -> tuple[Doubles, float]:
    """The origin [3] for cameras [4, 4], 0 unless they are far from it, and their extent."""
    centres = np.array([-each[:3, :3].T @ each[:3, 3] for each in viewmats])
    middle = centres.mean(axis=0)
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    if not 0 < extent < np.linalg.norm(middle) / _FAR:
        return np.zeros(3), extent or ORDINARY_EXTENT
    step = 2.0 ** np.floor(np.log2(extent))
    return np.rint(middle / step) * step, extent


def _moved(viewmat: Doubles, origin: Doubles) -> Doubles:
    """The camera [4, 4] in a frame that begins at `origin`."""
    moved = viewmat.copy()
    moved[:3, 3] += viewmat[:3, :3] @ origin
    return moved


def read_layout(folder: Path, skip_missing: bool) -> SceneLayout:
    """The photos and cameras of a scene, of which no image is decoded. Raises InputError."""
    try:
        if not folder.is_dir():
            found = what_it_is(folder) if folder.exists() else "nothing there"
            raise InputError(f"{folder}: expected a scene folder, found {found}. Known layouts: {_KNOWN}")
        # The order matters: COLMAP and NeRF-synthetic scenes may contain a transforms.json made from them,
        # and Nerfstudio's scenes contain the COLMAP model that they were made from.
        if colmap_model_folder(folder, MODEL_PLACES[:-1]) is not None:
            return read_colmap(folder, skip_missing=skip_missing)
        if (folder / "transforms_train.json").is_file():
            return read_blender(folder, skip_missing=skip_missing)
        if (folder / "transforms.json").is_file():
            return read_nerfstudio(folder, skip_missing=skip_missing)
        if colmap_model_folder(folder) is not None:
            return read_colmap(folder, skip_missing=skip_missing)
        entries = sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from error
    found = ", ".join(entries[:8]) + (", ..." if len(entries) > 8 else "") or "an empty folder"
    if kind := kind_of_folder(folder):
        raise InputError(f"{folder}: expected a scene or a model, found {kind}")
    raise InputError(f"{folder}: expected a scene, found {found}. Known layouts: {_KNOWN}")


def _on_images(folder: Path, photos: Sequence[Photo], sizes: Sequence[tuple[int, int]]) -> list[Photo]:
    """The photos with lenses for their images, which have these sizes (width, height).

    Raises InputError where the aspect does not fit. Tells of images whose size is not that of their camera
    divided by a whole number, by a KeyssWarning.
    """
    fitted, scaled = [], []
    for photo, size in zip(photos, sizes, strict=True):
        lens = photo.lens.on_image(*size)
        pair = f"{photo.lens.width}x{photo.lens.height}", f"{size[0]}x{size[1]}"
        if lens is None:
            turned = is_turned(photo.path)
            raise InputError(
                f"{photo.path}: expected the size of its camera, {pair[0]}, or another of that aspect, found "
                f"{pair[1]}; "
                + (
                    "its EXIF orientation rotates it: rotate its pixels"
                    if turned
                    else "resize it instead of "
                    "cropping it, or compute the cameras from the photos as they are"
                )
            )
        if not photo.lens.is_divided_for(*size):
            scaled.append(f"{photo.name} has {pair[1]} pixels, its camera {pair[0]}")
        fitted.append(replace(photo, lens=lens))
    if scaled:
        warnings.warn(
            f"{folder}: the intrinsics of {len(scaled):,} of {len(photos):,} photos are scaled to their "
            f"size: {scaled[0]}",
            KeyssWarning,
            stacklevel=3,
        )
    return fitted


def _view(
    photo: Photo,
    width: int | None,
    background: Floats,
    undistortions: Callable[[Lens, str], Undistortion],
    near: float,
) -> View:
    pixels, lens = read_image(photo.path, background), photo.lens
    if photo.mask:
        pixels = np.dstack([pixels, read_mask(photo.mask, lens.width, lens.height)])
    if not lens.is_pinhole:
        straighten = undistortions(lens, str(photo.path.parent))
        pixels, lens = straighten(pixels), straighten.pinhole
    camera = Camera(
        viewmat=torch.from_numpy(photo.viewmat.astype(np.float32)),
        K=torch.from_numpy(lens.K.astype(np.float32)),
        width=lens.width,
        height=lens.height,
        name=photo.name,
        near=near,
    )
    if width is not None and width < camera.width:
        height = max(1, round(camera.height * width / camera.width))
        camera, pixels = camera.resized(width, height), shrink(pixels, width, height)
    image, counts = torch.from_numpy(np.ascontiguousarray(pixels[:, :, :3])), pixels[:, :, 3:] == 255
    if photo.mask and not counts.any():
        raise InputError(
            f"{photo.mask}: expected a mask that leaves something of its photo, found a black one"
        )
    return View(camera, image, mask=torch.from_numpy(counts[:, :, 0]) if photo.mask else None)
