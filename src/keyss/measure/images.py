"""How near pictures are to others of the same views, by the usual measures, each named for what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import fmean

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from keyss.core.errors import BackendError, InputError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
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
    """How near a picture is to another. SSIMs: 11 x 11 Gaussian window of sigma 1.5, mean over RGB."""

    psnr: float  # dB; 120, the most, where nothing differs
    ssim_3dgs: float  # as 3DGS computes it, with zeros around the picture
    # Without the border of 5 pixels that the window does not fit in (Wang et al. 2004; what scikit-image and
    # pytorch-msssim give).
    ssim_standard: float
    lpips_alex: float | None = None  # LPIPS 0.1 with AlexNet, from 0; of pictures of at least 31 x 31 pixels
    flip: float | None = None  # mean of LDR-FLIP (Andersson et al. 2020), 0 to 1, at 67 pixels per degree


@dataclass(frozen=True)
class ViewScores:
    """One picture."""

    name: str
    scores: ImageScores


@dataclass(frozen=True)
class ImageComparison:
    """Pictures against others of the same names."""

    views: tuple[ViewScores, ...]
    mean: ImageScores  # over the pictures (Mip-NeRF 360's protocol for PSNR)
    missing: dict[str, str]  # by the field of ImageScores that is None, how to get what it needs


def compare_images(
    reference: Pictures, other: Pictures, *, lpips: bool = True, flip: bool = True
) -> ImageComparison:
    """Pictures against those of the same names.

    Give folders of pictures, whose suffixes do not matter (transparent ones are laid over black), or
    sequences of names and uint8 images [H, W, 3], such as `keyss.render` returns. LPIPS and FLIP are left out
    where `lpips` or `flip` is false or what they need is not installed. Raises InputError for what has no
    partner, for pictures of different or less than 11 x 11 pixels, and for what cannot be read as pictures.
    """
    ours, theirs = _by_stem(reference), _by_stem(other)
    alone = sorted(ours.keys() ^ theirs.keys())
    if alone or not ours:
        raise InputError(
            f"expected pictures of the same names on both sides, got {len(ours)} and {len(theirs)}; "
            f"without a partner: {', '.join(alone[:5])}{', ...' if len(alone) > 5 else ''}"
        )
    known = (("lpips_alex", lpips_alex, lpips), ("flip", _flip, flip))
    optional = {name: function for name, function, wanted in known if wanted}
    views: dict[str, dict[str, float]] = {}
    missing: dict[str, str] = {}
    for name in sorted(ours):
        a, b = _unit_range(name, ours[name], theirs[name])
        views[name] = {"psnr": psnr(a, b), **_ssim(a.numpy(), b.numpy())}
        for measure, function in optional.items():
            if measure not in missing:
                try:
                    views[name][measure] = function(a, b)
                except KeyssError as error:
                    missing[measure] = str(error)
    measured = [key for key in next(iter(views.values())) if key not in missing]
    return ImageComparison(
        tuple(
            ViewScores(name, ImageScores(**{key: view[key] for key in measured}))
            for name, view in views.items()
        ),
        ImageScores(**{key: fmean(view[key] for view in views.values()) for key in measured}),
        missing,
    )


def _by_stem(pictures: Pictures) -> dict[str, Path | Tensor | Pixels]:
    """Files or images by name, without its suffix and with folders made part of it, as of `keyss render`."""
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
    """Two pictures as float64 [H, W, 3] in [0, 1]."""
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


def _flip(a: Tensor, b: Tensor) -> float:
    try:
        flip = import_module("flip_evaluator")
    except ImportError as error:
        raise BackendError("FLIP needs the package flip-evaluator: pip install 'keyss[metrics]'") from error
    pair = a.float().numpy(), b.float().numpy()
    return float(flip.evaluate(*pair, "LDR", applyMagma=False, parameters={})[1])


def steganalysed(views: Sequence[View]) -> list[View]:
    """At most `STEGANALYSED_VIEWS` of them, spread evenly over the camera's path.

    In the order of the photos' names, which is that of the path more often than not.
    """
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), STEGANALYSED_VIEWS))


def photos_of(views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 photos [H, W, 3] of views, as `renders_of` has its pictures."""
    names = picture_names(view.camera for view in views)
    return [(name, view.image) for name, view in zip(names, views, strict=True)]


@torch.no_grad()
def renders_of(model: Gaussians, scene: Scene, views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 pictures [H, W, 3], on the CPU, of a model from the cameras of views of a scene."""
    background, found = scene.background.to(model.device), []
    names = picture_names(view.camera for view in views)
    for name, view in zip(names, views, strict=True):
        image = render(model, view.camera, background).clamp(0, 1)
        found.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return found
