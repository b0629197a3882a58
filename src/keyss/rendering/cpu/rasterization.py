"""Forward and backward pass as one torch.autograd.Function."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from keyss.core import BackendError
from keyss.kernels import memory
from keyss.kernels.jit import announce_compilation
from keyss.kernels.memory import Array
from keyss.kernels.parallel import run
from keyss.rendering.cpu import binning, blending, projection, projection_backward
from keyss.rendering.cpu.constants import (
    CAMERA,
    CHANNEL_MAX,
    FX,
    MOMENTS,
    PACKED,
    POSITION,
    RED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TX,
)

MAX_PAIRS = 2**31 - 1  # positions in the lists of tiles are int32


class GaussianArrays(NamedTuple):
    """N Gaussians, or gradients of the same shapes."""

    means: Array  # [N, 3]
    quats: Array  # [N, 4]
    scales: Array  # [N, 3]
    opacities: Array  # [N]
    colors: Array  # [N, K, 3] SH coefficients; [N, 1, channels] where sh_count is 0


class Settings(NamedTuple):
    """Arguments of a call that are not arrays; see `keyss.rendering.rasterization`."""

    width: int
    height: int
    near_plane: np.float32
    far_plane: np.float32
    eps2d: np.float32
    sh_count: int  # SH coefficients to use; 0 where colours are channels


class ProjectedArrays(NamedTuple):
    """Results of `projection.project` for N Gaussians."""

    footprints: Array  # [N, PACKED], see `constants`
    means2d: Array  # [N, 2] pixels
    depths: Array  # [N]; 0 for invisible Gaussians
    radii: Array  # [N, 2] int32, pixels; 0 for invisible Gaussians
    tile_bounds: Array  # [N] int32, upper bound on the number of tiles that the Gaussian touches


def rasterize(
    settings: Settings,
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    background: Tensor,  # [D]
    *gaussians: Tensor,  # see `GaussianArrays`
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render float32 contiguous CPU tensors. Returns the image [H, W, D], alpha [H, W] and meta."""
    count = len(gaussians[0])
    means2d = _empty(1, count, 2)
    # means2d is an input of the Function, which fills it and returns dL/d(means2d) as its gradient.
    *geometry, _ = gaussians
    means2d.requires_grad_(torch.is_grad_enabled() and any(tensor.requires_grad for tensor in geometry))
    depths, radii = _empty(1, count), _empty(1, count, 2, dtype=np.int32)
    image, alpha = _Rasterize.apply(  # type: ignore[no-untyped-call]
        settings, depths, radii, viewmat, K, background, means2d, *gaussians
    )
    return image, alpha, {"means2d": means2d, "depths": depths, "radii": radii}


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        settings: Settings,
        depths: Tensor,
        radii: Tensor,
        viewmat: Tensor,
        K: Tensor,
        background: Tensor,
        means2d: Tensor,
        *gaussians: Tensor,
    ) -> tuple[Tensor, Tensor]:
        announce_compilation()
        width, height = settings.width, settings.height
        image = _empty(height, width, len(background))
        alpha = _empty(height, width)
        transmittance = _empty(height, width)  # 1 - alpha, but exact where alpha is nearly 1
        arrays = GaussianArrays(*(tensor.detach().numpy() for tensor in gaussians))
        camera = _camera_array(viewmat, K)
        count = len(arrays.means)
        columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)

        footprints = memory.empty((count, PACKED), np.float32)
        slot_counts = memory.empty((count,), np.int32)  # upper bounds at first
        projected = ProjectedArrays(
            footprints, means2d.detach()[0].numpy(), depths[0].numpy(), radii[0].numpy(), slot_counts
        )
        run(projection.project, arrays, camera, settings, projected)
        features = None
        if settings.sh_count == 0:
            channels = arrays.colors[:, 0]
            hidden = ~(np.abs(channels) < CHANNEL_MAX).all(axis=1)  # NaN counts too
            projected.depths[hidden], projected.radii[hidden], slot_counts[hidden] = 0, 0, 0
            if channels.shape[1] == 3:  # fit into the footprints
                footprints[:, RED : RED + 3] = channels
            else:
                features = channels
        order, spare_order = (memory.empty((count,), np.int32) for _ in range(2))
        keys, spare_keys = (memory.empty((count,), np.uint32) for _ in range(2))
        visible = binning.sort_by_depth(projected.depths, order, spare_order, keys, spare_keys)
        order = order[:visible]

        shares = 4 * torch.get_num_threads() if torch.get_num_threads() > 1 else 1
        bounds = np.append(0, np.cumsum(slot_counts[order], dtype=np.int64))
        starts = bounds[np.arange(shares + 1) * visible // shares]
        max_pairs = int(bounds[-1])
        if max_pairs >= MAX_PAIRS:
            raise BackendError(
                f"{visible} Gaussians cover {max_pairs} tiles together, more than the CPU rasterizer can "
                f"list ({MAX_PAIRS}): render fewer or smaller Gaussians, or at a lower resolution"
            )
        tiles = memory.empty((max_pairs + 1,), np.int32)
        rows_of_pairs = memory.empty((max_pairs + 1,), np.int16)
        cursors = memory.empty((shares, columns * rows), np.int64)
        run(
            binning.list_pairs, footprints, order, columns, height, starts, tiles, rows_of_pairs, slot_counts,
            cursors,
        )  # fmt: skip
        counts = cursors.T.ravel()
        ends_of_counts = np.cumsum(counts)
        cursors[:] = (ends_of_counts - counts).reshape(-1, shares).T  # counts become starts
        tile_starts = np.append(cursors[0], ends_of_counts[-1])
        first_slots = np.cumsum(slot_counts, dtype=np.int32) - slot_counts
        pairs = int(tile_starts[-1])
        entries = memory.empty((pairs,), np.int64)
        entry_slots = memory.empty((pairs if any(ctx.needs_input_grad) else 0,), np.int32)
        run(
            binning.sort_pairs, order, starts, tiles, rows_of_pairs, slot_counts, first_slots, cursors,
            entries, entry_slots,
        )  # fmt: skip
        ends = memory.empty((columns * rows,), np.int64)
        run(
            blending.blend, footprints, features, entries, tile_starts, columns,
            background.detach().numpy(), image.numpy(), alpha.numpy(), transmittance.numpy(), ends,
        )  # fmt: skip
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*gaussians, image, transmittance)
            ctx.settings, ctx.camera = settings, camera
            ctx.footprints, ctx.features = footprints, features
            ctx.slots = first_slots, slot_counts
            ctx.lists = entries, entry_slots, tile_starts, ends
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image_gradient: Tensor, alpha_gradient: Tensor) -> tuple[Tensor | None, ...]:
        *gaussians, image, transmittance = ctx.saved_tensors
        settings: Settings = ctx.settings
        image_gradient, alpha_gradient = image_gradient.contiguous(), alpha_gradient.contiguous()
        need_colors = ctx.needs_input_grad[-1]

        shapes = [tuple(tensor.shape) for tensor in gaussians]
        if not need_colors:
            shapes[4] = (0, 1, image.shape[-1])
        gradients = [_empty(*shape) for shape in shapes]
        means2d_gradient = _empty(1, len(gaussians[0]), 2)
        channels = 0 if ctx.features is None else image.shape[-1]
        pairs = len(ctx.lists[0])
        moments = memory.empty((pairs * MOMENTS,), np.float32)
        extras = memory.empty((pairs * max(channels, 1),), np.float32)
        run(
            blending.blend_backward, ctx.footprints, ctx.features, *ctx.lists,
            -(-settings.width // TILE_WIDTH), image.numpy(), transmittance.numpy(), image_gradient.numpy(),
            alpha_gradient.numpy(), moments, extras,
        )  # fmt: skip
        run(
            projection_backward.project_backward,
            GaussianArrays(*(tensor.detach().numpy() for tensor in gaussians)), ctx.camera, settings,
            channels, ctx.footprints, *ctx.slots, moments, extras, need_colors,
            GaussianArrays(*(tensor.numpy() for tensor in gradients)), means2d_gradient[0].numpy(),
        )  # fmt: skip
        background_gradient = None
        if ctx.needs_input_grad[5]:
            # Unlike torch's sum, numpy's does not depend on the number of threads.
            weighted = (image_gradient.double() * transmittance.double()[..., None]).numpy()
            background_gradient = torch.from_numpy(weighted.sum((0, 1))).float()
        returned = (None, None, None, None, None, background_gradient, means2d_gradient, *gradients)
        return returned if need_colors else (*returned[:-1], None)


def _empty(*shape: int, dtype: Any = np.float32) -> Tensor:
    """An uninitialised tensor in recycled memory."""
    return torch.from_numpy(memory.empty(shape, dtype))


def _camera_array(viewmat: Tensor, K: Tensor) -> Array:
    """[CAMERA] the camera in the layout of the kernels."""
    view = viewmat.detach().double().numpy()
    intrinsics = K.detach().double().numpy()
    camera = memory.empty((CAMERA,), np.float32)
    camera[:TX] = view[:3, :3].ravel()
    camera[TX:FX] = view[:3, 3]
    camera[FX:POSITION] = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    camera[POSITION:] = -view[:3, :3].T @ view[:3, 3]
    return camera
