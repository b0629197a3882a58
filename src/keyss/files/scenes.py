"""Loads scenes of all layouts, photos included."""

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
from keyss.files.colmap import MODEL_PLACES, colmap_models, read_colmap
from keyss.files.file_kinds import identify_file, identify_folder
from keyss.files.images import downscale, is_rotated_by_exif, probe_image, read_image, read_mask
from keyss.files.lens import Lens, Undistortion, undistortion
from keyss.files.scene_layout import Photo, SceneLayout, leave_out
from keyss.files.transforms import read_blender, read_nerfstudio
from keyss.kernels.memory import available_memory

_ROUNDING = 1e-12  # relative error of a camera's position
_PLAIN = 0.8  # share of the pixels at the photos' edges that have the colour of a plain background
_NOISE = 8  # of a plain background, from 0 to 255
_FAR = 1000  # extents from the origin, where single precision resolves 1e-4 extents
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

    `width`: wider photos are undistorted, then downscaled to this width by area averaging, with K scaled per
    axis; photos are never enlarged.
    `background`: RGB in [0, 1], also under transparent pixels; by default white if any photo has an alpha
    channel, else the colour of four fifths of the pixels at the photos' edges, else black.
    `skip_missing`: leaves out photos that are missing on disk or have no usable camera, before test views are
    chosen, and damaged photos, with a KeyssWarning.

    A scene a thousand times farther from the origin than its extent, such as a georeferenced one, is moved to
    the origin, with a KeyssWarning: see `Scene.origin`.

    The test views are those of the layout's split if it has one, else every 8th image by name. Camera names
    are the layout's image paths, relative to `images/` for COLMAP and to the scene's folder for the others
    (`train/r_0.png`). If COLMAP's `images/` is missing, the largest of `images_2/`, `images_4/` and
    `images_8/` is used. A scene may lack points, with a KeyssWarning for COLMAP; see
    `keyss.fitting.parameters.initial_points`. Rotations are orthonormal up to float32.

    Masked pixels (`mask_path` in transforms.json; `masks/` beside COLMAP's `images/`) are ignored, with a
    KeyssWarning: see `View.mask`. So are resampled pixels that overlap a masked one.

    Raises InputError for an unknown layout, broken or truncated files, missing or undecodable images, images
    whose aspect differs from their camera's by more than a pixel, photos that exceed the free memory, or a
    scene without training or test images.
    Raises UsageError for a `width` or `background` out of range.
    """
    if width is not None and width < 1:
        raise UsageError(f"expected a width of at least 1 pixel, got {width}")
    behind = None if background is None else checked_background(background)
    folder = Path(path)
    layout = read_layout(folder, skip_missing)
    for part, purpose in ((layout.train, "to train on"), (layout.test, "to test on")):
        if not part:
            raise InputError(f"{folder}: expected at least one image {purpose}, found none")

    origin, extent = origin_and_extent([photo.viewmat for photo in layout.train])
    if origin.any():
        where = ", ".join(f"{coordinate:.9g}" for coordinate in origin)
        warnings.warn(
            f"{folder}: too far from the origin for single precision: the scene and its models are moved by "
            f"minus ({where})",
            KeyssWarning,
            stacklevel=2,
        )
    near = NEAR * min(1.0, extent / ORDINARY_EXTENT)
    photos = [replace(photo, viewmat=recentre(photo.viewmat, origin)) for photo in layout.train + layout.test]
    probed, damaged = [], []
    for photo in photos:  # finds missing photos before decoding any
        try:
            probed.append((photo, probe_image(photo.path)))
        except InputError:
            if not skip_missing:
                raise
            damaged.append(photo.name)
    sizes = [(width, height) for _, (width, height, _) in probed]
    _check_memory(folder, sizes, width)
    photos = [_fit_lens(photo, size) for (photo, _), size in zip(probed, sizes, strict=True)]
    transparent = any(transparent for _, (*_, transparent) in probed)
    under = torch.ones(3) if behind is None else behind  # transparent pixels
    # Most scenes have one lens, and a map is as large as a photo.
    undistortions = functools.lru_cache(maxsize=2)(undistortion)
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        decode = functools.partial(
            _load_view, width=width, background=under.numpy(), undistortions=undistortions, near=near
        )
        views = []
        for photo, pending in [(photo, pool.submit(decode, photo)) for photo in photos]:
            try:
                views.append(pending.result())
            except InputError:
                if not skip_missing:
                    raise
                damaged.append(photo.name)
    leave_out(folder, len(layout.train + layout.test), "cannot be read", damaged, skip_missing)
    if behind is None:
        behind = under if transparent else plain_background([(view.image, view.mask) for view in views])
    held_out = {photo.name for photo in layout.test}
    if shares := [float((~view.mask).float().mean()) for view in views if view.mask is not None]:
        warnings.warn(
            f"{folder}: {len(shares):,} of {len(views):,} photos have masks, which leave "
            f"{sum(shares) / len(shares):.0%} of their pixels out of training and measures",
            KeyssWarning,
            stacklevel=2,
        )
    return Scene(
        name=folder.resolve().name,
        train=tuple(view for view in views if view.camera.name not in held_out),
        test=tuple(view for view in views if view.camera.name in held_out),
        points=torch.from_numpy((layout.points.xyz - origin).astype(np.float32)),
        colors=torch.from_numpy(layout.points.rgb),
        background=behind,
        origin=torch.from_numpy(origin),
    )


def plain_background(photos: Sequence[tuple[Tensor, Tensor | None]]) -> Tensor:
    """[3] in [0, 1]: the colour around an object before a plain background, black if there is none.

    `photos`: uint8 images [H, W, 3] and masks [H, W] of the pixels that count.
    """

    def edges(of: Tensor) -> Tensor:
        return torch.cat([of[0], of[-1], of[1:-1, 0], of[1:-1, -1]])

    parts = [edges(image) if mask is None else edges(image)[edges(mask)] for image, mask in photos]
    around = torch.cat(parts).float()
    if not len(around):
        return torch.zeros(3)
    colour = around.median(0).values
    plain = ((around - colour).abs() <= _NOISE).all(1).float().mean() >= _PLAIN
    return colour / 255 if plain else torch.zeros(3)


def _check_memory(folder: Path, sizes: Sequence[tuple[int, int]], width: int | None) -> None:
    """Raise InputError if photos of these widths and heights, shrunk to `width`, do not fit into memory."""
    shrunk = [min(1.0, (width or columns) / columns) for columns, _ in sizes]
    needed = sum(3 * w * h * share**2 for (w, h), share in zip(sizes, shrunk, strict=True))
    if needed > (available := available_memory()):
        widest = max(w * share for (w, _), share in zip(sizes, shrunk, strict=True))
        half = max(1, int(widest * (available / needed / 2) ** 0.5))
        raise InputError(
            f"{folder}: the pixels of {len(sizes):,} photos take {needed / 1e9:.1f} GB of memory, and "
            f"{available / 1e9:.1f} GB are free; `width={half}` takes half of that"
        )


def origin_and_extent(viewmats: Sequence[Doubles]) -> tuple[Doubles, float]:
    """The origin [3] of the scene's frame, 0 unless the cameras [4, 4] are far from it, and their extent."""
    centres = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in viewmats])
    centre = centres.mean(axis=0)
    extent, distance = float(np.linalg.norm(centres - centre, axis=1).max()), np.linalg.norm(centre)
    if extent <= _ROUNDING * distance:  # all cameras are in one place
        extent = ORDINARY_EXTENT
    if extent >= distance / _FAR:
        return np.zeros(3), extent
    step = 2.0 ** np.floor(np.log2(extent))
    return np.rint(centre / step) * step, extent


def recentre(viewmat: Doubles, origin: Doubles) -> Doubles:
    """The camera [4, 4] in the frame at `origin`."""
    recentred = viewmat.copy()
    recentred[:3, 3] += viewmat[:3, :3] @ origin
    return recentred


def read_layout(folder: Path, skip_missing: bool) -> SceneLayout:
    """The photos and cameras of a scene, without decoding images. Raises InputError."""
    try:
        if not folder.is_dir():
            listing = identify_file(folder) if folder.exists() else "nothing there"
            raise InputError(f"{folder}: expected a scene folder, found {listing}. Known layouts: {_KNOWN}")
        # In this order, because COLMAP and NeRF-synthetic scenes may contain a derived transforms.json, and
        # Nerfstudio's scenes contain their COLMAP model.
        if colmap_models(folder, MODEL_PLACES[:-1]):
            return read_colmap(folder, skip_missing=skip_missing)
        if (folder / "transforms_train.json").is_file():
            return read_blender(folder, skip_missing=skip_missing)
        if (folder / "transforms.json").is_file():
            return read_nerfstudio(folder, skip_missing=skip_missing)
        if colmap_models(folder):
            return read_colmap(folder, skip_missing=skip_missing)
        entries = sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from error
    listing = ", ".join(entries[:8]) + (", ..." if len(entries) > 8 else "") or "an empty folder"
    if kind := identify_folder(folder):
        raise InputError(f"{folder}: expected a scene or a model, found {kind}")
    raise InputError(f"{folder}: expected a scene, found {listing}. Known layouts: {_KNOWN}")


def _fit_lens(photo: Photo, size: tuple[int, int]) -> Photo:
    """The photo with its lens scaled to its image (width, height). Raises InputError for another aspect."""
    lens = photo.lens.scale_to(*size)
    if lens is None:
        advice = "resize it instead of cropping it, or compute the cameras from the photos as they are"
        if is_rotated_by_exif(photo.path):
            advice = "its EXIF orientation rotates it: rotate its pixels"
        raise InputError(
            f"{photo.path}: expected the size of its camera, {photo.lens.width}x{photo.lens.height}, or "
            f"another of that aspect, found {size[0]}x{size[1]}; {advice}"
        )
    return replace(photo, lens=lens)


def _load_view(
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
        camera, pixels = camera.resized(width, height), downscale(pixels, width, height)
    image, counts = torch.from_numpy(np.ascontiguousarray(pixels[:, :, :3])), pixels[:, :, 3:] == 255
    if photo.mask and not counts.any():
        raise InputError(f"{photo.mask}: expected a mask that keeps part of its photo, found a black one")
    return View(camera, image, mask=torch.from_numpy(counts[:, :, 0]) if photo.mask else None)
