"""Checks of what `rasterization` is called with, the same for every backend."""

from __future__ import annotations

from typing import Any, Literal, get_args

from torch import Tensor

from keyss.core import UsageError
from keyss.rendering.cpu.layout import CHANNEL_MAX, EPS2D_MIN

MAX_SIDE = 2**16  # pixels
MAX_CHANNELS = 32
CAMERA_MAX = 1e12  # in viewmats and Ks: products of such numbers are still floats
FOCAL_LENGTH_MIN = 1e-6  # pixels

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
RENDER_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
RASTERIZE_MODES: tuple[RasterizeMode, ...] = get_args(RasterizeMode)

# Arguments of gsplat's that have one value here: without distortion, a shutter that rolls, and so on.
ONLY_VALUES: dict[str, Any] = {
    "sparse_grad": False,
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
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    sh_degree: int | None,
    backgrounds: Tensor | None,
    render_mode: str,
    rasterize_mode: str,
    **others: Any,
) -> None:
    """Raise ValueError for a wrong shape or value, UsageError for what gsplat supports and we do not."""
    _check_others(**others)
    for name, mode, modes in (
        ("render_mode", render_mode, RENDER_MODES),
        ("rasterize_mode", rasterize_mode, RASTERIZE_MODES),
    ):
        if mode not in modes:
            raise ValueError(f"{name}: expected one of {', '.join(modes)}, got {mode!r}")
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": backgrounds,
    }
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) and (name, tensor) != ("backgrounds", None):
            raise ValueError(f"{name}: expected a torch tensor, got {type(tensor).__name__}")
    for name, tensor, shape in (("means", means, "[N, 3]"), ("viewmats", viewmats, "[C, 4, 4]")):
        _check_dimensions(name, tensor, shape, "batch dimensions are not supported")
    count, cameras = len(means), len(viewmats)
    _check_shape("means", means, count, 3)
    _check_shape("quats", quats, count, 4)
    _check_shape("scales", scales, count, 3)
    _check_shape("opacities", opacities, count)
    _check_shape("viewmats", viewmats, cameras, 4, 4)
    _check_shape("Ks", Ks, cameras, 3, 3)
    _check_colors(colors, count, sh_degree)
    if backgrounds is not None:
        _check_shape("backgrounds", backgrounds, cameras, colors.shape[-1])
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if not tensor.is_floating_point():
            raise ValueError(f"{name}: expected floating point numbers, got {tensor.dtype}")
        if tensor.device != means.device:
            raise ValueError(f"{name}: is on {tensor.device}, but means is on {means.device}")
    if means.device.type == "cpu":  # on a GPU these checks would wait for what it is doing
        _check_cameras(viewmats, Ks, backgrounds)
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name}: expected 1 to {MAX_SIDE} pixels, got {side}")
    if not 0 < near_plane < far_plane:
        raise ValueError(f"expected 0 < near_plane < far_plane, got {near_plane} and {far_plane}")
    if not EPS2D_MIN <= eps2d < 1e6:
        raise ValueError(
            f"eps2d: expected {EPS2D_MIN} or more, got {eps2d}: narrower footprints would be "
            f"drawn wrongly by the CPU rasterizer"
        )


def _check_others(tile_size: int, channel_chunk: int, **others: Any) -> None:
    for name, number in (("tile_size", tile_size), ("channel_chunk", channel_chunk)):
        if not (isinstance(number, int) and number > 0):
            raise ValueError(f"{name}: expected a positive integer, got {number!r}")
    for name, only in ONLY_VALUES.items():
        given = others[name]
        if name == "rolling_shutter" and getattr(given, "name", None) == "GLOBAL":
            continue  # gsplat's word for none
        if isinstance(given, Tensor) or given != only:
            got = f"a tensor {list(given.shape)}" if isinstance(given, Tensor) else repr(given)
            raise UsageError(f"{name}: only {only!r} is supported of what gsplat can do here, got {got}")


def _check_colors(colors: Tensor, count: int, sh_degree: int | None) -> None:
    reason = "colors are the same for every camera"
    if sh_degree is None:
        _check_dimensions("colors", colors, f"[{count}, D]", reason)
        _check_shape("colors", colors, count, colors.shape[1])
        if not 1 <= colors.shape[1] <= MAX_CHANNELS:
            raise UsageError(f"colors: 1 to {MAX_CHANNELS} channels are supported, got {list(colors.shape)}")
        return
    if sh_degree == 4:
        raise UsageError("sh_degree: spherical harmonics up to degree 3 are supported, got degree 4")
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0, 1, 2, 3 or None, got {sh_degree!r}")
    _check_dimensions("colors", colors, f"[{count}, K, 3]", reason)
    _check_shape("colors", colors, count, colors.shape[1], 3)
    if colors.shape[1] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors: sh_degree {sh_degree} needs at least {(sh_degree + 1) ** 2} coefficients, "
            f"got {list(colors.shape)}"
        )


def _check_dimensions(name: str, tensor: Tensor, shape: str, reason_for_more: str) -> None:
    """Raise UsageError for more dimensions than in `shape`, which gsplat allows, ValueError for fewer."""
    expected = f"{name}: expected shape {shape}, got {list(tensor.shape)}"
    if tensor.dim() > shape.count(",") + 1:
        raise UsageError(f"{expected}: {reason_for_more}")
    if tensor.dim() < shape.count(",") + 1:
        raise ValueError(expected)


def _check_cameras(viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None) -> None:
    """Raise ValueError where a number would spoil every pixel; bad Gaussians are only left out."""
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
    focal_lengths = Ks.detach()[:, [0, 1], [0, 1]]
    if not bool((focal_lengths > FOCAL_LENGTH_MIN).all()):
        raise ValueError(
            f"Ks: expected focal lengths above {FOCAL_LENGTH_MIN:g} pixels, got others in {list(Ks.shape)}"
        )


def _check_shape(name: str, tensor: Tensor, *shape: int) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name}: expected shape {list(shape)}, got {list(tensor.shape)}")
