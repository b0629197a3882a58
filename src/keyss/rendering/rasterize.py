"""`rasterization`: gsplat's function of that name, on whichever device the Gaussians are."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from keyss.core import UsageError
from keyss.rendering import cuda
from keyss.rendering.arguments import RasterizeMode, RenderMode, check_arguments
from keyss.rendering.cpu.layout import CHANNEL_MAX, EPS2D_MIN
from keyss.rendering.cpu.rasterization import Settings, rasterize as rasterize_on_cpu


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, K, 3] or [N, D]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D_MIN,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw N Gaussians into C images (3DGS, Kerbl et al. 2023, eq. 3 to 5), as `gsplat.rasterization` does.

    Gaussians on the CPU are drawn by the kernels in `keyss.rendering.cpu`, those on a GPU by gsplat. All
    arguments of gsplat 1.5 are there, in its order. `packed`, `tile_size`, `channel_chunk` and `segmented`
    say how gsplat computes: they change nothing here, except that the last three are passed to gsplat on a
    GPU. Those that are not described below have one value that is supported, their default.

    Args:
        means: centres in the world.
        quats: rotations as wxyz, of any length.
        scales: standard deviations, positive.
        opacities: in [0, 1].
        colors: SH coefficients where `sh_degree` is given, with colour = max(0.5 + basis . colors, 0);
            else 1 to 32 channels of anything, drawn as they are.
        viewmats: world to camera, rigid motions, OpenCV axes.
        Ks: pinhole intrinsics in pixels, without skew; pixel centres lie at half-integers.
        width: pixels.
        height: pixels.
        near_plane: nearest depth that is drawn, positive.
        far_plane: farthest depth that is drawn.
        radius_clip: Gaussians with no larger radius, in pixels, are not drawn.
        eps2d: variance in pixels^2 added to every footprint, 0.3 or more.
        sh_degree: degree up to which to use the SH coefficients, 0 to 3, with K >= (sh_degree + 1)^2.
        backgrounds: colour behind everything; black when None.
        absgrad: also sum absolute gradients into `meta["means2d"].absgrad` (AbsGS).
        render_mode: what the channels of the image are: "RGB", the colours; "D", the depths along the
            camera's axis, accumulated like a colour; "ED", the expected depth: that divided by alpha; or
            "RGB+D" and "RGB+ED", the colours and then the depth. Behind everything the depth is 0.
        rasterize_mode: "classic"; or "antialiased", where opacities are multiplied by
            sqrt(det(S) / det(S + eps2d I)) with the covariance S of the footprint in the image, so that
            small Gaussians do not grow brighter by being widened (Mip-Splatting, Yu et al. 2024).

    Returns:
        Images [C, H, W, D], with D as `render_mode` says, not clamped above; alphas [C, H, W, 1] in [0, 1];
        and a dictionary with what gsplat's strategies read where they are told `packed=False`: means2d
        [C, N, 2] in pixels (after backward its `.grad` holds dL/d(means2d)), radii [C, N, 2] int32 in pixels
        (0 where not drawn), depths [C, N], width, height, n_cameras, gaussian_ids (None).

    On the CPU there are gradients to all tensors but Ks, everything is computed in float32 and is
    bit-identical from run to run and for any number of threads, Gaussians that are not finite or have a
    colour or depth of 1e12 or more are not drawn, and means2d is a leaf: losses on it do not reach the means.

    Raises:
        ValueError: a shape, dtype or number is not as above.
        UsageError: an option, shape or device that gsplat may support and this function does not, by name.
        BackendError: gsplat's CUDA kernels are missing, or memory for the lists of tiles is out of reach.
    """
    arguments = dict(locals())
    check_arguments(**arguments)
    if means.device.type == "cuda":
        return cuda.rasterize(arguments)
    if means.device.type != "cpu":
        raise UsageError(f"means: only tensors on 'cpu' or 'cuda' can be drawn, got {means.device}")
    with_colors, with_depth = render_mode.startswith("RGB"), render_mode.endswith("D")
    if sh_degree is None:
        colors = colors[:, None]
    if not with_colors:
        colors, sh_degree = colors.new_empty(len(means), 1, 0), None
    settings = Settings(
        width=int(width),
        height=int(height),
        near_plane=near_plane,
        far_plane=min(far_plane, float(CHANNEL_MAX)),
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_count=0 if sh_degree is None else (sh_degree + 1) ** 2,
        color_channels=colors.shape[2],
        with_depth=with_depth,
        antialiased=rasterize_mode == "antialiased",
        absgrad=absgrad,
    )
    if backgrounds is None or not with_colors:
        backgrounds = torch.zeros(len(viewmats), settings.channels)
    elif with_depth:
        backgrounds = torch.nn.functional.pad(backgrounds, (0, 1))
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds = (
        tensor.float().contiguous() for tensor in tensors
    )
    images, alphas, meta = rasterize_on_cpu(
        means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, settings
    )
    if render_mode.endswith("ED"):
        depths = images[..., -1:] / alphas.clamp_min(1e-10)
        images = torch.cat([images[..., :-1], depths], dim=-1)
    meta.update(
        width=settings.width,
        height=settings.height,
        n_cameras=len(viewmats),
        n_batches=1,
        batch_ids=None,
        camera_ids=None,
        gaussian_ids=None,
        opacities=opacities.expand(len(viewmats), -1),
    )
    return images, alphas, meta
