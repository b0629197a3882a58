"""How close images are to references of the same views: PSNR, SSIM in two variants, LPIPS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from keyss.core import Gaussians, InputError, KeyssError, Scene, View
from keyss.files.images import picture_names, read_image
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.measure.lpips import lpips_alex
from keyss.rendering import render

Pixels = npt.NDArray[np.uint8]
Doubles = npt.NDArray[np.float64]
Pictures = Path | str | Sequence[tuple[str, Tensor | Pixels]]

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
STEGANALYSED_VIEWS = 64
RADIUS = 5  # SSIM's 11 x 11 window


@dataclass(frozen=True)
class ImageScores:
    """How close an image is to its reference. SSIM: 11 x 11 Gaussian window of sigma 1.5, mean over RGB."""

    psnr: float  # dB; at most 120, for equal images
    ssim_3dgs: float  # as 3DGS computes it, with zero padding
    ssim_standard: float  # without the border of 5 pixels (Wang et al. 2004, scikit-image, pytorch-msssim)
    lpips_alex: float | None = None  # LPIPS 0.1 with AlexNet, from 0; needs at least 31 x 31 pixels


@dataclass(frozen=True)
class ViewScores:
    """The scores of one view."""

    name: str
    scores: ImageScores


@dataclass(frozen=True)
class ImageComparison:
    """Images against references of the same names."""

    views: tuple[ViewScores, ...]
    mean: ImageScores  # over the views (Mip-NeRF 360's protocol for PSNR)
    missing: str | None = None  # why there is no LPIPS


def compare_images(reference: Pictures, other: Pictures) -> ImageComparison:
    """Scores of images against references of the same names.

    Both are folders of images, whose suffixes do not matter and whose transparent pixels become black, or
    sequences of names and uint8 images [H, W, 3], such as `keyss.render` returns. LPIPS is left out if its
    weights are not installed. Raises InputError for images without a partner, of different sizes or smaller
    than 11 x 11 pixels, and for files that are not images.
    """
    ours, theirs = _by_stem(reference), _by_stem(other)
    alone = sorted(ours.keys() ^ theirs.keys())
    if alone or not ours:
        raise InputError(
            f"expected pictures of the same names on both sides, got {len(ours)} and {len(theirs)}; "
            f"without a partner: {', '.join(alone[:5])}{', ...' if len(alone) > 5 else ''}"
        )
    views: dict[str, dict[str, float]] = {}
    missing = None
    for name in sorted(ours):
        a, b = _unit_range(name, ours[name], theirs[name])
        views[name] = {"psnr": psnr(a, b), **_ssim(a.numpy(), b.numpy())}
        try:
            views[name]["lpips_alex"] = lpips_alex(a, b)
        except KeyssError as error:
            missing = str(error)
    measured = set.intersection(*map(set, views.values()))
    return ImageComparison(
        tuple(
            ViewScores(name, ImageScores(**{key: view[key] for key in measured}))
            for name, view in views.items()
        ),
        ImageScores(**{key: fmean(view[key] for view in views.values()) for key in measured}),
        missing,
    )


def _by_stem(pictures: Pictures) -> dict[str, Path | Tensor | Pixels]:
    """Files or images by name without suffix; folders become part of the name, as in `keyss render`."""
    if isinstance(pictures, str | Path):
        folder = Path(pictures)
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder of pictures")
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
        named: list[tuple[str, Path | Tensor | Pixels]] = [(path.name, path) for path in files]
    else:
        named = list(pictures)
    found: dict[str, Path | Tensor | Pixels] = {}
    for name, picture in named:
        flat = Path(name.replace("/", "_").replace("\\", "_"))
        stem = flat.stem if flat.suffix.lower() in SUFFIXES else flat.name
        if stem in found:
            raise InputError(f"expected one picture of each name, got two called {stem}")
        found[stem] = picture
    return found


def _unit_range(name: str, *pair: Path | Tensor | Pixels) -> list[Tensor]:
    """Two images as float64 [H, W, 3] in [0, 1]."""
    black = np.zeros(3, np.float32)
    a, b = (read_image(each, black) if isinstance(each, Path) else np.asarray(each) for each in pair)
    for each in (a, b):
        if each.dtype != np.uint8 or each.ndim != 3 or each.shape[2] != 3:
            raise InputError(f"{name}: expected uint8 [H, W, 3], got {each.dtype} {list(each.shape)}")
    if a.shape != b.shape or min(a.shape[:2]) <= 2 * RADIUS:
        sizes = f"{a.shape[1]}x{a.shape[0]} and {b.shape[1]}x{b.shape[0]}"
        raise InputError(f"{name}: expected two pictures of one size, at least 11x11, got {sizes}")
    return [torch.from_numpy(each / 255) for each in (a, b)]


def _ssim(a: Doubles, b: Doubles) -> dict[str, float]:
    blur = partial(gaussian_filter, sigma=1.5, mode="constant", radius=RADIUS, axes=(0, 1))
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = blur(a), blur(b)
    variances = blur(a * a) - mean_a**2 + blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    values = numerator / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    inside = values[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return {"ssim_3dgs": float(values.mean()), "ssim_standard": float(inside.mean())}


def steganalysed(views: Sequence[View]) -> list[View]:
    """At most `STEGANALYSED_VIEWS` of them, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), STEGANALYSED_VIEWS))


def photos_of(views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 photos [H, W, 3] of views, in the form of `renders_of`."""
    names = picture_names(view.camera for view in views)
    return [(name, view.image) for name, view in zip(names, views, strict=True)]


@torch.no_grad()
def renders_of(model: Gaussians, scene: Scene, views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model from the cameras of a scene's views."""
    background, found = scene.background.to(model.device), []
    names = picture_names(view.camera for view in views)
    for name, view in zip(names, views, strict=True):
        image = render(model, view.camera, background).clamp(0, 1)
        found.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return found
