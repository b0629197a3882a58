"""Checks of the arguments of `rasterization`, the same for every backend."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from keyss.core import UsageError
from keyss.rendering.cpu.constants import CHANNEL_MAX, EPS2D_MIN

MAX_SIDE = 2**16  # pixels
MAX_CHANNELS = 32
CAMERA_MAX = 1e12  # bounds viewmats and Ks, so that products do not overflow
FOCAL_LENGTH_MIN = 1e-6  # pixels

_BATCHES = "batch dimensions are not supported"
_NO_CAMERAS = "colors are the same for every camera"

# Arguments of gsplat that do not affect results.
IGNORED = frozenset(("packed", "tile_size", "channel_chunk", "segmented"))
# Arguments of gsplat that must have their default.
ONLY_VALUES: dict[str, Any] = {
    "radius_clip": 0.0,
    "render_mode": "RGB",
    "rasterize_mode": "classic",
    "sparse_grad": False,
    "absgrad": False,
    "distributed": False,
    "camera_model": "pinhole",
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}


def check_arguments(
    tensors: Mapping[str, Tensor],
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    sh_degree: int | None,
    others: Mapping[str, Any],
) -> None:
    """Raise ValueError for invalid shapes and values, UsageError for unsupported features of gsplat."""
    _check_others(others)
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {type(tensor).__name__}")
    means, viewmats, Ks = tensors["means"], tensors["viewmats"], tensors["Ks"]
    _check_shape("means", means, "N", 3, reason_for_more=_BATCHES)
    _check_shape("viewmats", viewmats, "C", 4, 4, reason_for_more=_BATCHES)
    count, cameras = len(means), len(viewmats)
    _check_shape("quats", tensors["quats"], count, 4)
    _check_shape("scales", tensors["scales"], count, 3)
    _check_shape("opacities", tensors["opacities"], count)
    _check_shape("Ks", Ks, cameras, 3, 3)
    _check_colors(tensors["colors"], count, sh_degree)
    if "backgrounds" in tensors:
        _check_shape("backgrounds", tensors["backgrounds"], cameras, tensors["colors"].shape[-1])
    for name, tensor in tensors.items():
        if not tensor.is_floating_point():
            raise ValueError(f"{name}: expected floating point numbers, got {tensor.dtype}")
        if tensor.device != means.device:
            raise ValueError(f"{name}: is on {tensor.device}, but means is on {means.device}")
        if name in ("viewmats", "Ks") and tensor.requires_grad:
            raise UsageError(f"{name}: gradients of cameras are not supported")
    if means.device.type == "cpu":  # on a GPU these checks would wait for it
        _check_cameras(viewmats, Ks, tensors.get("backgrounds"))
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name}: expected 1 to {MAX_SIDE} pixels, got {side}")
    if not 0 < near_plane < far_plane:
        raise ValueError(f"expected 0 < near_plane < far_plane, got {near_plane} and {far_plane}")
    if not EPS2D_MIN <= eps2d < 1e6:
        raise ValueError(
            f"eps2d: expected {EPS2D_MIN} or more, got {eps2d}: the CPU rasterizer would render narrower "
            "footprints wrongly"
        )


def _check_others(others: Mapping[str, Any]) -> None:
    for name, value in others.items():
        if name in IGNORED:
            continue
        if name not in ONLY_VALUES:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue  # gsplat's default
        if isinstance(value, Tensor) or value != ONLY_VALUES[name]:
            got = f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else repr(value)
            raise UsageError(f"{name}: only {ONLY_VALUES[name]!r} is supported, got {got}")


def _check_colors(colors: Tensor, count: int, sh_degree: int | None) -> None:
    if sh_degree is None:
        _check_shape("colors", colors, count, "D", reason_for_more=_NO_CAMERAS)
        if not 1 <= colors.shape[1] <= MAX_CHANNELS:
            raise UsageError(f"colors: 1 to {MAX_CHANNELS} channels are supported, got {list(colors.shape)}")
        return
    if sh_degree == 4:
        raise UsageError("sh_degree: spherical harmonics up to degree 3 are supported, got degree 4")
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0, 1, 2, 3 or None, got {sh_degree!r}")
    _check_shape("colors", colors, count, "K", 3, reason_for_more=_NO_CAMERAS)
    if colors.shape[1] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors: sh_degree {sh_degree} needs at least {(sh_degree + 1) ** 2} coefficients, "
            f"got {list(colors.shape)}"
        )


def _check_cameras(viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None) -> None:
    """Raise ValueError for numbers that would affect every pixel; invalid Gaussians are only skipped."""
    limits = {
        "viewmats": (viewmats, CAMERA_MAX),
        "Ks": (Ks, CAMERA_MAX),
        "backgrounds": (backgrounds, float(CHANNEL_MAX)),
    }
    for name, (tensor, limit) in limits.items():
        if tensor is not None and not bool((tensor.detach().abs() < limit).all()):
            raise ValueError(
                f"{name}: expected finite numbers below {limit:g}, got others in {list(tensor.shape)}"
            )
    focal_lengths = Ks[:, [0, 1], [0, 1]]
    if not bool((focal_lengths > FOCAL_LENGTH_MIN).all()):
        raise ValueError(
            f"Ks: expected focal lengths above {FOCAL_LENGTH_MIN:g} pixels, got others in {list(Ks.shape)}"
        )


def _check_shape(name: str, tensor: Tensor, *shape: int | str, reason_for_more: str | None = None) -> None:
    """Raise ValueError for another shape; letters stand for any size.

    With a reason, raise UsageError for more dimensions, which gsplat allows.
    """
    expected = f"{name}: expected shape [{', '.join(map(str, shape))}], got {list(tensor.shape)}"
    if reason_for_more is not None and tensor.dim() > len(shape):
        raise UsageError(f"{expected}: {reason_for_more}")
    pairs = zip(shape, tensor.shape, strict=False)
    if tensor.dim() != len(shape) or any(isinstance(own, int) and own != size for own, size in pairs):
        raise ValueError(expected)
