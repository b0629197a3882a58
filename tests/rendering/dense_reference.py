"""The rasterizer written down once more, as slowly and plainly as possible: float64, every Gaussian at every
pixel, gradients by autograd. Follows the 3DGS paper, eq. 3 to 5, with gsplat's constants."""

from __future__ import annotations

import torch
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4


def rotation_matrices(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def sh_basis(degree: int, directions: Tensor) -> Tensor:
    """[N, (degree + 1)^2] from unit directions: the formulas as printed in the textbooks."""
    x, y, z = directions.unbind(-1)
    pi = torch.pi
    bands = [
        [0.5 / pi**0.5 * torch.ones_like(x)],
        [-((3 / (4 * pi)) ** 0.5) * y, (3 / (4 * pi)) ** 0.5 * z, -((3 / (4 * pi)) ** 0.5) * x],
        [
            0.5 * (15 / pi) ** 0.5 * x * y,
            -0.5 * (15 / pi) ** 0.5 * y * z,
            0.25 * (5 / pi) ** 0.5 * (3 * z * z - 1),
            -0.5 * (15 / pi) ** 0.5 * x * z,
            0.25 * (15 / pi) ** 0.5 * (x * x - y * y),
        ],
        [
            -0.25 * (35 / (2 * pi)) ** 0.5 * y * (3 * x * x - y * y),
            0.5 * (105 / pi) ** 0.5 * x * y * z,
            -0.25 * (21 / (2 * pi)) ** 0.5 * y * (5 * z * z - 1),
            0.25 * (7 / pi) ** 0.5 * z * (5 * z * z - 3),
            -0.25 * (21 / (2 * pi)) ** 0.5 * x * (5 * z * z - 1),
            0.25 * (105 / pi) ** 0.5 * z * (x * x - y * y),
            -0.25 * (35 / (2 * pi)) ** 0.5 * x * (x * x - 3 * y * y),
        ],
    ]
    return torch.stack([entry for band in bands[: degree + 1] for entry in band], -1)


def dense_rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
    sh_degree: int | None = None,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    shifts: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, Tensor]:
    """Image [H, W, D], alpha [H, W], and a mask [H, W] of the pixels where no decision was a close call.

    All inputs float64; a colour is SH coefficients where sh_degree is given. `shifts` [N, H * W, 2] moves
    each projected centre as each pixel sees it: its gradient is that of means2d, pixel by pixel.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    if sh_degree is not None:
        position = -rotation.T @ translation
        directions = torch.nn.functional.normalize(means - position, dim=-1)
        basis = sh_basis(sh_degree, directions)
        colors = (0.5 + torch.einsum("nk,nkc->nc", basis, colors[:, : basis.shape[1]])).clamp_min(0)

    in_camera = means @ rotation.T + translation
    order = in_camera[:, 2].argsort()
    order = order[in_camera[order, 2] >= near_plane]
    x, y, z = in_camera[order].unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    v = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    half = jacobian @ rotation @ rotation_matrices(quats[order]) @ torch.diag_embed(scales[order])
    sharp = half @ half.mT
    covariance = sharp + eps2d * torch.eye(2, dtype=means.dtype)
    conic = torch.linalg.inv(covariance)
    opacities = opacities[order]
    if rasterize_mode == "antialiased":
        opacities = opacities * (torch.linalg.det(sharp) / torch.linalg.det(covariance)).sqrt()
    depth = in_camera[order, 2:]
    colors, background = {
        "RGB": lambda: (colors[order], background),
        "D": lambda: (depth, background.new_zeros(1)),
        "RGB+D": lambda: (
            torch.cat([colors[order], depth], -1),
            torch.cat([background, background.new_zeros(1)]),
        ),
    }[render_mode.replace("ED", "D")]()

    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).to(means).reshape(-1, 2)
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    offsets = pixels - centres[:, None]  # [N, P, 2]
    if shifts is not None:
        offsets = offsets - shifts[order]
    sigma = 0.5 * torch.einsum("npi,nij,npj->np", offsets, conic, offsets)
    footprint = opacities[:, None] * torch.exp(-sigma)
    alpha = torch.where(footprint >= ALPHA_MIN, footprint.clamp_max(ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, 0)
    drawn = after > TRANSMITTANCE_MIN
    alpha = alpha * drawn
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after])[:-1]
    last = torch.cat([torch.ones_like(before[:1]), after])[-1] if len(after) else pixels.new_ones(len(pixels))
    image = (alpha * before).mT @ colors + last[:, None] * background
    if render_mode.endswith("ED"):
        image = torch.cat([image[:, :-1], image[:, -1:] / (1 - last[:, None]).clamp_min(1e-10)], -1)

    def near(values: Tensor, threshold: float) -> Tensor:
        return ((values / threshold - 1).abs() < 3e-4).any(0)

    unstopped = torch.cumprod(1 - torch.where(footprint >= ALPHA_MIN, footprint.clamp_max(ALPHA_MAX), 0.0), 0)
    close_call = near(footprint, ALPHA_MIN) | near(footprint, ALPHA_MAX) | near(unstopped, TRANSMITTANCE_MIN)
    shape = (height, width)
    return image.reshape(*shape, -1), (1 - last).reshape(shape), ~close_call.reshape(shape)
