"""Forward and backward pass of all cameras as one torch.autograd.Function."""

from __future__ import annotations

from dataclasses import dataclass
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
from keyss.rendering.cpu.constants import CAMERA, FX, MOMENTS, PACKED, POSITION, TILE_HEIGHT, TILE_WIDTH, TX

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

    footprints: Array  # [N, PACKED], see `layout`
    features: Array  # [N, channels] colours; no columns if they are in the footprints
    means2d: Array  # [N, 2] pixels
    depths: Array  # [N]; 0 for invisible Gaussians
    radii: Array  # [N, 2] int32, pixels; 0 for invisible Gaussians
    tile_bounds: Array  # [N] int32, upper bound on the number of tiles that the Gaussian touches


@dataclass(frozen=True)
class Rendering:
    """Results of one camera's forward pass that the backward pass needs."""

    camera: Array  # [CAMERA], see `layout`
    footprints: Array  # [N, PACKED]
    features: Array | None  # [N, channels] colours; None if they are in the footprints
    first_slots: Array  # [N] first slot of each Gaussian's pairs
    slot_counts: Array  # [N] number of its pairs
    tile_starts: Array  # [tiles + 1] first list entry of each tile
    entries: Array  # [pairs] Gaussians and their rows, see `layout.ENTRY_ROWS_SHIFT`
    entry_slots: Array  # [pairs] the slot of each list entry; empty without gradients
    ends: Array  # [tiles] list entry at which the tile was full


def rasterize(
    settings: Settings,
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    backgrounds: Tensor,  # [C, D]
    *gaussians: Tensor,  # see `GaussianArrays`
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render float32 contiguous CPU tensors. Returns images [C, H, W, D], alphas [C, H, W, 1] and meta."""
    cameras, count = len(viewmats), len(gaussians[0])
    means2d = _empty(cameras, count, 2)
    # means2d is an input of the Function, which fills it and returns dL/d(means2d) as its gradient.
    *geometry, _ = gaussians
    means2d.requires_grad_(torch.is_grad_enabled() and any(tensor.requires_grad for tensor in geometry))
    meta: dict[str, Any] = {
        "means2d": means2d,
        "depths": _empty(cameras, count),
        "radii": _empty(cameras, count, 2, dtype=np.int32),
    }
    images, alphas = _Rasterize.apply(  # type: ignore[no-untyped-call]
        settings, meta, viewmats, Ks, backgrounds, means2d, *gaussians
    )
    return images, alphas, meta


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        settings: Settings,
        meta: dict[str, Any],
        viewmats: Tensor,
        Ks: Tensor,
        backgrounds: Tensor,
        means2d: Tensor,
        *gaussians: Tensor,
    ) -> tuple[Tensor, Tensor]:
        announce_compilation()
        shape = (len(viewmats), settings.height, settings.width)
        images = _empty(*shape, backgrounds.shape[1])
        alphas = _empty(*shape, 1)
        transmittances = _empty(*shape)  # 1 - alphas, but exact where alpha is nearly 1
        arrays = GaussianArrays(*(tensor.detach().numpy() for tensor in gaussians))
        renderings = []
        for c in range(len(viewmats)):
            rendering = _render(
                arrays,
                _camera_array(viewmats[c], Ks[c]),
                settings,
                backgrounds[c].detach().numpy(),
                any(ctx.needs_input_grad),
                means2d.detach()[c].numpy(),
                meta["depths"][c].numpy(),
                meta["radii"][c].numpy(),
                images[c].numpy(),
                alphas[c, ..., 0].numpy(),
                transmittances[c].numpy(),
            )
            if any(ctx.needs_input_grad):
                renderings.append(rendering)
        ctx.save_for_backward(*gaussians, images, transmittances)
        ctx.means2d = means2d
        ctx.renderings = renderings
        ctx.settings = settings
        return images, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, images_gradient: Tensor, alphas_gradient: Tensor) -> tuple[Tensor | None, ...]:
        *gaussians, images, transmittances = ctx.saved_tensors
        settings: Settings = ctx.settings
        images_gradient = images_gradient.contiguous()
        alphas_gradient = alphas_gradient.reshape(transmittances.shape).contiguous()
        need_background, need_colors = ctx.needs_input_grad[4], ctx.needs_input_grad[-1]

        shapes = [tuple(tensor.shape) for tensor in (*gaussians, ctx.means2d)]
        if not need_colors:
            shapes[4] = (0, 1, images.shape[-1])
        *shapes, means2d_shape = shapes
        means2d_gradient = _empty(*means2d_shape)
        gradients = [] if ctx.renderings else [torch.zeros(shape) for shape in shapes]
        arrays = GaussianArrays(*(tensor.detach().numpy() for tensor in gaussians))
        for c, rendering in enumerate(ctx.renderings):
            own = [_empty(*shape) for shape in shapes]
            channels = 0 if rendering.features is None else images.shape[-1]
            slots = len(rendering.entries)
            moments = memory.empty((slots * MOMENTS,), np.float32)
            extras = memory.empty((slots * max(channels, 1),), np.float32)
            run(
                blending.blend_backward, rendering.footprints, rendering.features,
                rendering.entries, rendering.entry_slots, rendering.tile_starts, rendering.ends,
                -(-settings.width // TILE_WIDTH), images[c].numpy(), transmittances[c].numpy(),
                images_gradient[c].numpy(), alphas_gradient[c].numpy(), moments, extras,
            )  # fmt: skip
            run(
                projection_backward.project_backward, arrays, rendering.camera, settings, channels,
                rendering.footprints, rendering.first_slots, rendering.slot_counts, moments, extras,
                need_colors, GaussianArrays(*(tensor.numpy() for tensor in own)), means2d_gradient[c].numpy(),
            )  # fmt: skip
            gradients = [a.add_(b) for a, b in zip(gradients, own, strict=True)] if c else own
        backgrounds_gradient = None
        if need_background:
            # Unlike torch's sum, numpy's does not depend on the number of threads.
            weighted = (images_gradient.double() * transmittances.double()[..., None]).numpy()
            backgrounds_gradient = torch.from_numpy(weighted.sum((1, 2))).float()
        returned = (None, None, None, None, backgrounds_gradient, means2d_gradient, *gradients)
        return tuple(
            gradient if needed else None
            for gradient, needed in zip(returned, ctx.needs_input_grad, strict=True)
        )


def _empty(*shape: int, dtype: Any = np.float32) -> Tensor:
    """An uninitialised tensor in recycled memory."""
    return torch.from_numpy(memory.empty(shape, dtype))


def _render(
    gaussians: GaussianArrays,
    camera: Array,
    settings: Settings,
    background: Array,
    for_backward: bool,
    means2d: Array,
    depths: Array,
    radii: Array,
    image: Array,
    alpha: Array,
    transmittance: Array,
) -> Rendering:
    """One camera's forward pass; fills the last six arrays."""
    count = len(gaussians.means)
    width, height = settings.width, settings.height
    columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)

    footprints = memory.empty((count, PACKED), np.float32)
    # Three colours fit into the footprints.
    channels = 0 if image.shape[2] == 3 else image.shape[2]
    features = memory.empty((count, channels), np.float32)
    slot_counts = memory.empty((count,), np.int32)  # upper bounds at first
    projected = ProjectedArrays(footprints, features, means2d, depths, radii, slot_counts)
    run(projection.project, gaussians, camera, settings, projected)
    order, spare_order = (memory.empty((count,), np.int32) for _ in range(2))
    keys, spare_keys = (memory.empty((count,), np.uint32) for _ in range(2))
    visible = binning.sort_by_depth(depths, order, spare_order, keys, spare_keys)
    order = order[:visible]

    shares = 4 * torch.get_num_threads() if torch.get_num_threads() > 1 else 1
    bounds = np.append(0, np.cumsum(slot_counts[order], dtype=np.int64))
    starts = bounds[np.arange(shares + 1) * visible // shares]
    max_pairs = int(bounds[-1])
    if max_pairs >= MAX_PAIRS:
        raise BackendError(
            f"{visible} Gaussians cover {max_pairs} tiles together, more than the CPU rasterizer can list "
            f"({MAX_PAIRS}): render fewer or smaller Gaussians, or at a lower resolution"
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
    entry_slots = memory.empty((pairs if for_backward else 0,), np.int32)
    run(
        binning.sort_pairs, order, starts, tiles, rows_of_pairs, slot_counts, first_slots, cursors, entries,
        entry_slots,
    )  # fmt: skip
    ends = memory.empty((columns * rows,), np.int64)
    used_features = features if channels else None
    run(
        blending.blend, footprints, used_features, entries, tile_starts, columns, background, image, alpha,
        transmittance, ends,
    )  # fmt: skip
    return Rendering(
        camera, footprints, used_features, first_slots, slot_counts, tile_starts, entries, entry_slots, ends
    )


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
