"""A dense reference rasterizer: float64, every Gaussian at every pixel, gradients by autograd.

Follows the 3DGS paper, eq. 3 to 5, with gsplat's constants.
"""

from __future__ import annotations

import torch
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4

Margins = dict[str, Tensor]


def rotation_matrices(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def sh_basis(degree: int, directions: Tensor) -> Tensor:
    """Real spherical harmonics [N, (degree + 1)^2] of unit directions."""
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
    margins: Margins | None = None,
) -> tuple[Tensor, Tensor]:
    """Image [H, W, D] and alpha [H, W] of one camera.

    Colours are SH coefficients if `sh_degree` is given. `shifts` [N, H * W, 2] moves each projected centre
    per pixel; its gradient is that of means2d. `margins` receives the distance [N] of each Gaussian to each
    threshold; see `clear_cut`.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    if sh_degree is not None:
        position = -rotation.T @ translation
        directions = torch.nn.functional.normalize(means - position, dim=-1)
        basis = sh_basis(sh_degree, directions)
        unclamped = 0.5 + torch.einsum("nk,nkc->nc", basis, colors[:, : basis.shape[1]])
        colors = unclamped.clamp_min(0)

    in_camera = means @ rotation.T + translation
    order = in_camera[:, 2].argsort(stable=True)
    order = order[in_camera[order, 2] >= near_plane]
    x, y, z = in_camera[order].unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    limits_x = (-cx / fx - margin_x, (width - cx) / fx + margin_x)
    limits_y = (-cy / fy - margin_y, (height - cy) / fy + margin_y)
    u, v = (x / z).clamp(*limits_x), (y / z).clamp(*limits_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    half = jacobian @ rotation @ rotation_matrices(quats[order]) @ torch.diag_embed(scales[order])
    covariance = half @ half.mT + eps2d * torch.eye(2, dtype=means.dtype)
    opacities = opacities[order]
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    found: Margins | None = None if margins is None else {}
    image, alpha = dense_blending(
        centres,
        torch.linalg.inv(covariance),
        opacities,
        colors[order],
        width,
        height,
        background,
        None if shifts is None else shifts[order],
        found,
    )

    if margins is not None and found is not None:
        z_all, infinity = in_camera[:, 2], torch.full_like(in_camera[:, 2], torch.inf)
        found["the view where the perspective is linearised"] = torch.stack(
            [(x / z - limit).abs() for limit in limits_x] + [(y / z - limit).abs() for limit in limits_y]
        ).amin(0)
        # Equal depths keep the order of the arguments.
        gaps = torch.diff(z)
        gaps = torch.where(gaps == 0, torch.inf, gaps)
        found["order"] = torch.minimum(
            torch.cat([gaps, gaps.new_full((1,), torch.inf)])[: len(z)],
            torch.cat([gaps.new_full((1,), torch.inf), gaps])[: len(z)],
        )
        for name, values in found.items():
            margins[name] = infinity.index_copy(0, order, values).detach()
        # Depths are exact where the camera looks along an axis.
        distance = (z_all - near_plane).abs()
        on_plane = (distance == 0) & ((rotation == 0) | (rotation.abs() == 1)).all()
        margins["near plane"] = torch.where(on_plane, torch.inf, distance).detach()
        if sh_degree is not None:
            seen = z_all[:, None] >= near_plane
            margins["black"] = torch.where(seen, unclamped.abs(), torch.inf).amin(1).detach()
    return image, alpha


def dense_blending(
    centres: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    width: int,
    height: int,
    background: Tensor,
    shifts: Tensor | None = None,
    margins: Margins | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend 2D Gaussians with conics [N, 2, 2] front to back: image [H, W, D] and alpha [H, W]."""
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).to(centres).reshape(-1, 2)
    offsets = pixels - centres[:, None]  # [N, P, 2]
    if shifts is not None:
        offsets = offsets - shifts
    sigma = 0.5 * torch.einsum("npi,nij,npj->np", offsets, conics, offsets)
    footprint = opacities[:, None] * torch.exp(-sigma)
    unstopped = torch.where(footprint >= ALPHA_MIN, footprint.clamp_max(ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - unstopped, 0)
    alpha = unstopped * (after > TRANSMITTANCE_MIN)
    if margins is not None:
        # No threshold applies after a pixel has stopped or to a Gaussian that is too faint.
        before = torch.cat([torch.ones_like(after[:1]), after])[:-1]
        decided = (before > TRANSMITTANCE_MIN) & (unstopped > 0)
        for name, values, threshold, asked in (
            ("alpha 1/255", footprint, ALPHA_MIN, before > TRANSMITTANCE_MIN),
            ("alpha 0.999", footprint, ALPHA_MAX, before > TRANSMITTANCE_MIN),
            ("transmittance", after, TRANSMITTANCE_MIN, decided),
        ):
            margin = torch.where(asked, (values / threshold - 1).abs(), torch.inf)
            margins[name] = margin.amin(1).detach()
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after])
    last = before[-1]
    image = (alpha * before[:-1]).mT @ channels + last[:, None] * background
    shape = (height, width)
    return image.reshape(*shape, -1), (1 - last).reshape(shape)
