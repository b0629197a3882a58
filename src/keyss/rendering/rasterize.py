"""Render Gaussians: on the CPU by the kernels in `keyss.rendering.cpu`, on a GPU by gsplat; the device."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core import BackendError, Camera, Gaussians, UsageError
from keyss.core.picture_network import DecodedGaussians, PictureNetwork
from keyss.rendering.cpu.constants import CHANNEL_MAX, EPS2D
from keyss.rendering.cpu.rasterization import Settings, rasterize as rasterize_on_cpu

Backend = Literal["auto", "cpu", "cuda"]
MAX_SIDE = 2**16  # pixels
MAX_CHANNELS = 32
CAMERA_MAX = 1e12  # bounds viewmats and Ks, so that products do not overflow
FOCAL_LENGTH_MIN = 1e-6  # pixels
_FAR_PLANE = 1e10  # gsplat's default


def render(gaussians: Gaussians, camera: Camera, background: Tensor | None = None) -> Tensor:
    """Render an image [H, W, 3]: 0 is black, 1 is white, not clamped above.

    `background` [3]: black if None; a model that a network decodes has its own. Renders on the device of the
    Gaussians; differentiable. Raises the errors of `rasterization`.
    """
    return render_with_meta(gaussians, camera, background)[0]


def render_with_meta(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """`render`, and the meta of `rasterization` with the `alpha` [H, W].

    `sh_degree`: maximum degree of the spherical harmonics, by default all.
    """
    if sh_degree is None:
        sh_degree = gaussians.sh_degree
    if not isinstance(gaussians, DecodedGaussians):
        return render_features(gaussians, gaussians.sh, camera, background, sh_degree)
    network, colors = gaussians.network, gaussians.sh
    if gaussians.features is not None:
        colors, sh_degree = gaussians.features, None
    image, meta = render_features(gaussians, colors, camera, network.background, sh_degree)
    return decode_picture(image, network), meta


def render_features(
    gaussians: Gaussians,
    features: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    sh_degree: int | None = None,
) -> tuple[Tensor, dict[str, Any]]:
    """`render_with_meta` with `features` [N, C] instead of colours, or harmonics up to `sh_degree`.

    The image is [H, W, C].
    """
    device = gaussians.device
    image, alpha, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        features,
        camera.viewmat.to(device),
        camera.K.to(device),
        camera.width,
        camera.height,
        near_plane=camera.near,
        sh_degree=sh_degree,
        background=None if background is None else background.to(device),
    )
    return image, meta | {"alpha": alpha}


def decode_picture(features: Tensor, network: PictureNetwork) -> Tensor:
    """Decode an image [H, W, 3] from rendered features [H, W, C] (GS-Hider, Zhang et al. 2024, 3.3)."""
    planes = features.permute(2, 0, 1)[None]
    for index, (weight, bias) in enumerate(network.layers):
        planes = F.conv2d(planes if index == 0 else planes.relu(), weight, bias, padding=1)
    return planes[0].permute(1, 2, 0).contiguous()


@torch.enable_grad()
def contributions(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """[N] blending weights of each Gaussian, summed over all pixels of all views."""
    model = gaussians.detach()
    # An image is linear in the colours: the gradient with respect to a colour is the sum of its weights.
    grey = torch.zeros(len(model), 1, device=model.device, requires_grad=True)
    total = torch.zeros(len(model), device=model.device)
    for camera in cameras:
        image, _ = render_features(model, grey, camera)
        total += torch.autograd.grad(image.sum(), grey)[0][:, 0]
    return total


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, K, 3] or [N, D]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    sh_degree: int | None = None,
    background: Tensor | None = None,  # [D]
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into an image (3DGS, Kerbl et al. 2023, eq. 3 to 5), like `gsplat.rasterization`.

    Args:
        means: centres in the world.
        quats: rotations as wxyz, of any length.
        scales: standard deviations, positive.
        opacities: in [0, 1].
        colors: SH coefficients where `sh_degree` is given, with colour = max(0.5 + basis . colors, 0);
            else 1 to 32 feature channels, rendered without an activation.
        viewmat: world to camera, a rigid motion, OpenCV axes.
        K: pinhole intrinsics in pixels, without skew; pixel centres are at half-integers.
        width: pixels.
        height: pixels.
        near_plane: minimum depth, positive.
        sh_degree: degree up to which to use the SH coefficients, 0 to 3, with K >= (sh_degree + 1)^2.
        background: colour behind everything; black when None.

    Returns:
        The image [H, W, D], not clamped above, with D = 3 for SH; alpha [H, W] in [0, 1]; and a dictionary
        with the entries that gsplat's strategies read: means2d [1, N, 2] in pixels (after backward its
        `.grad` holds dL/d(means2d)), radii [1, N, 2] int32 in pixels (0 for invisible Gaussians), depths
        [1, N], width, height, n_cameras.

    All tensors but the camera have gradients. Everything is computed in float32. On the CPU, results are
    bit-identical for any number of threads; Gaussians that are not finite or have a colour of 1e12 or more
    are skipped; and means2d is a leaf: losses on it do not reach the means.

    Raises:
        ValueError: a shape, dtype or number is invalid.
        BackendError: gsplat's CUDA kernels are missing, or the lists of tiles would take too much memory.
    """
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmat": viewmat,
        "K": K,
        "background": means.new_zeros(colors.shape[-1:]) if background is None else background,
    }
    _check(tensors, width, height, near_plane, sh_degree)
    tensors = {name: tensor.float().contiguous() for name, tensor in tensors.items()}
    camera = [tensors.pop(name) for name in ("viewmat", "K", "background")]
    if means.device.type == "cuda":
        _require_gsplat()
        import gsplat

        names = ("viewmats", "Ks", "backgrounds")
        images, alphas, meta = gsplat.rasterization(
            **tensors,
            **{name: tensor[None] for name, tensor in zip(names, camera, strict=True)},
            width=width,
            height=height,
            near_plane=near_plane,
            far_plane=_FAR_PLANE,
            eps2d=EPS2D,
            sh_degree=sh_degree,
            packed=False,
        )
        # squeeze, unlike indexing, needs no copy in the backward pass.
        return images.squeeze(0), alphas.squeeze(0).squeeze(-1), meta
    if sh_degree is None:
        tensors["colors"] = tensors["colors"][:, None]
    settings = Settings(
        int(width),
        int(height),
        np.float32(near_plane),
        np.float32(_FAR_PLANE),
        np.float32(EPS2D),
        sh_count=0 if sh_degree is None else (sh_degree + 1) ** 2,
    )
    image, alpha, meta = rasterize_on_cpu(settings, *camera, *tensors.values())
    return image, alpha, meta | {"width": settings.width, "height": settings.height, "n_cameras": 1}


def _check(
    tensors: dict[str, Tensor], width: int, height: int, near_plane: float, sh_degree: int | None
) -> None:
    """Raise ValueError for shapes with which kernels would read other memory, and for senseless numbers."""
    colors, count = tensors["colors"], tensors["means"].shape[:1]
    least, most, rgb = (1, MAX_CHANNELS, ()) if sh_degree is None else ((sh_degree + 1) ** 2, 16, (3,))
    size = colors.shape[1] if colors.dim() > 1 else 0
    if sh_degree not in (None, 0, 1, 2, 3) or not least <= size <= most:
        raise ValueError(f"colors: unexpected shape {list(colors.shape)} with sh_degree {sh_degree}")
    expected = {
        "means": (*count, 3),
        "quats": (*count, 4),
        "scales": (*count, 3),
        "opacities": count,
        "colors": (*count, size, *rgb),
        "viewmat": (4, 4),
        "K": (3, 3),
        "background": colors.shape[-1:],
    }
    for name, shape in expected.items():
        if tuple(tensors[name].shape) != shape:
            raise ValueError(f"{name}: expected shape {list(shape)}, got {list(tensors[name].shape)}")
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name}: expected 1 to {MAX_SIDE} pixels, got {side}")
    if not 0 < near_plane < _FAR_PLANE:
        raise ValueError(f"near_plane: expected 0 to {_FAR_PLANE:g}, got {near_plane}")
    if tensors["means"].device.type != "cpu":  # checks of values would wait for a GPU
        return
    # Numbers that affect every pixel; invalid Gaussians are only skipped.
    for name, limit in (("viewmat", CAMERA_MAX), ("K", CAMERA_MAX), ("background", float(CHANNEL_MAX))):
        if not bool((tensors[name].detach().abs() < limit).all()):
            raise ValueError(f"{name}: expected finite numbers below {limit:g}, got others")
    if not bool((tensors["K"].diagonal()[:2] > FOCAL_LENGTH_MIN).all()):
        raise ValueError(f"K: expected focal lengths above {FOCAL_LENGTH_MIN:g} pixels, got others")


def resolve_device(backend: Backend = "auto") -> torch.device:
    """The device for the Gaussians, which also selects the rasterizer.

    "auto" is CUDA if torch sees a GPU, else the CPU; a GPU that gsplat cannot use is skipped with a
    RuntimeWarning. Raises BackendError if "cuda" cannot be used.
    """
    if backend not in ("auto", "cpu", "cuda"):
        raise UsageError(f"device: expected 'auto', 'cpu' or 'cuda', got {backend!r}")
    if backend == "cpu" or (backend == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    try:
        _require_gsplat()
    except BackendError as error:
        if backend == "cuda":
            raise
        warnings.warn(f"rendering on the CPU: {error}", RuntimeWarning, stacklevel=2)
        return torch.device("cpu")
    return torch.device("cuda")


def _require_gsplat() -> None:
    """Raise BackendError unless gsplat can render on a GPU. May compile its kernels, which takes minutes."""
    if not torch.cuda.is_available():
        raise BackendError("torch sees no CUDA GPU on this machine; use device 'auto' or 'cpu'")
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendError(f"gsplat's CUDA kernels cannot be loaded ({error}); use device 'cpu'") from error
    if _C is None:
        raise BackendError(
            "gsplat's CUDA kernels are missing, and without a CUDA toolkit (nvcc) they cannot be built; "
            "use device 'cpu'"
        )
