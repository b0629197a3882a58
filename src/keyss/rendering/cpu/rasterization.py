"""The kernels put together: forward and backward of all cameras as one torch.autograd.Function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from keyss.core import BackendError
from keyss.rendering.cpu import (
    binning,
    blending,
    blending_backward,
    memory,
    projection,
    projection_backward,
)
from keyss.rendering.cpu.jit import announce_compilation
from keyss.rendering.cpu.layout import (
    CAMERA,
    CHUNK,
    FX,
    MOMENTS,
    PACKED,
    POSITION,
    TILE_HEIGHT,
    TILE_WIDTH,
    TX,
)
from keyss.rendering.cpu.memory import Array
from keyss.rendering.cpu.parallel import run
from keyss.rendering.cpu.records import GaussianArrays, ProjectedArrays, ViewSettings

MAX_PAIRS = 2**31 - 1  # places in the lists of tiles are int32


@dataclass(frozen=True)
class Settings:
    """What a call is made with besides tensors; see `keyss.rendering.rasterization`."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_count: int  # SH coefficients to use; 0 where colours are channels
    color_channels: int
    with_depth: bool  # draw the depth as one more channel
    antialiased: bool
    absgrad: bool

    def view(self, camera: Array) -> ViewSettings:
        """What kernels need to know of a camera [CAMERA]."""
        distances = (self.near_plane, self.far_plane, self.eps2d, self.radius_clip)
        near, far, eps2d, radius_clip = (np.float32(distance) for distance in distances)
        return ViewSettings(
            camera, self.width, self.height, near, far, eps2d, radius_clip, self.antialiased, self.sh_count
        )

    @property
    def channels(self) -> int:
        """How many channels the image has."""
        return self.color_channels + self.with_depth

    @property
    def feature_channels(self) -> int:
        """Channels in an array of their own; 0 where the three colours lie in the footprints."""
        return self.channels if self.with_depth or self.color_channels != 3 else 0

    @property
    def extra_width(self) -> int:
        """Floats per (Gaussian, tile) pair beside the `layout.MOMENTS`."""
        return (self.feature_channels or 1) + (2 if self.absgrad else 0)


@dataclass(frozen=True)
class Drawing:
    """What the backward pass needs to know of one camera's forward pass."""

    view: ViewSettings
    footprints: Array  # [N, PACKED]
    features: Array | None  # [N, feature_channels] channels to draw; None for colours in the footprints
    first_slots: Array  # [N] first slot of each Gaussian's pairs
    slot_counts: Array  # [N] how many pairs it has
    tile_starts: Array  # [tiles + 1] first list entry of each tile
    entries: Array  # [pairs] Gaussians and their rows, see `layout.ENTRY_ROWS_SHIFT`
    entry_slots: Array  # [pairs] the slot of each list entry; empty where no gradients are needed
    ends: Array  # [tiles] first list entry that the tile did not come to


def rasterize(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, K, 3] SH coefficients; [N, 1, color_channels] where settings.sh_count is 0
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    backgrounds: Tensor,  # [C, D] with D = settings.channels
    settings: Settings,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw float32 contiguous CPU tensors. Returns images [C, H, W, D], alphas [C, H, W, 1] and meta."""
    cameras, count = len(viewmats), len(means)
    means2d = _empty(cameras, count, 2)
    # The gradient with respect to the projected centres is handed out through an input of its own: the
    # Function reads nothing from it, but returns dL/d(means2d) for it.
    geometry = (means, quats, scales, opacities, viewmats)
    means2d.requires_grad_(torch.is_grad_enabled() and any(tensor.requires_grad for tensor in geometry))
    meta: dict[str, Any] = {
        "means2d": means2d,
        "depths": _empty(cameras, count),
        "radii": _empty(cameras, count, 2, dtype=np.int32),
    }
    images, alphas = _Rasterize.apply(  # type: ignore[no-untyped-call]
        means, quats, scales, opacities, colors, viewmats, backgrounds, means2d, Ks, settings, meta
    )
    return images, alphas, meta


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        backgrounds: Tensor,
        means2d: Tensor,
        Ks: Tensor,
        settings: Settings,
        meta: dict[str, Any],
    ) -> tuple[Tensor, Tensor]:
        announce_compilation()
        shape = (len(viewmats), settings.height, settings.width)
        images = _empty(*shape, settings.channels)
        alphas = _empty(*shape, 1)
        transmittances = _empty(*shape)  # 1 - alphas, without the rounding where alpha is nearly 1
        tensors = (means, quats, scales, opacities, colors)
        gaussians = GaussianArrays(*(tensor.detach().numpy() for tensor in tensors))
        drawings = []
        for c in range(len(viewmats)):
            drawing = _draw(
                gaussians,
                settings.view(_camera_array(viewmats[c], Ks[c])),
                backgrounds[c].detach().numpy(),
                settings,
                any(ctx.needs_input_grad),
                means2d.detach()[c].numpy(),
                meta["depths"][c].numpy(),
                meta["radii"][c].numpy(),
                images[c].numpy(),
                alphas[c, ..., 0].numpy(),
                transmittances[c].numpy(),
            )
            if any(ctx.needs_input_grad):
                drawings.append(drawing)
        ctx.save_for_backward(means, quats, scales, opacities, colors, viewmats, images, transmittances)
        ctx.means2d = means2d
        ctx.drawings = drawings
        ctx.settings = settings
        ctx.set_materialize_grads(False)
        return images, alphas

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, images_gradient: Tensor | None, alphas_gradient: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        means, quats, scales, opacities, colors, viewmats, images, transmittances = ctx.saved_tensors
        settings: Settings = ctx.settings
        if images_gradient is None:
            images_gradient = torch.zeros_like(images)
        if alphas_gradient is None:
            alphas_gradient = torch.zeros_like(transmittances)
        images_gradient = images_gradient.contiguous()
        alphas_gradient = alphas_gradient.reshape(transmittances.shape).contiguous()
        need_colors, need_camera, need_background = ctx.needs_input_grad[4:7]

        gaussians = (means, quats, scales, opacities, colors)
        shapes = [tuple(tensor.shape) for tensor in (*gaussians, ctx.means2d)]
        if not need_colors:
            shapes[4] = (0, 1, settings.color_channels)
        *gradients, means2d_gradient = (_empty(*shape) for shape in shapes)
        if not ctx.drawings:  # no camera, and it is the first one that overwrites what is in this memory
            for gradient in gradients:
                gradient.zero_()
        absgrad = torch.empty_like(ctx.means2d if settings.absgrad else means2d_gradient[:, :0])
        pieces = -(-len(means) // CHUNK)
        camera_gradient = np.zeros((pieces if need_camera else 0, 15))
        viewmats_gradient = torch.zeros_like(viewmats) if need_camera else None
        arrays, gradient_arrays = (
            GaussianArrays(*(tensor.detach().numpy() for tensor in tensors))
            for tensors in (gaussians, gradients)
        )
        for c, drawing in enumerate(ctx.drawings):
            moments, extras = _blend_backward(
                drawing,
                images[c].numpy(),
                transmittances[c].numpy(),
                images_gradient[c].numpy(),
                alphas_gradient[c].numpy(),
                settings,
            )
            run(
                projection_backward.project_backward, arrays, drawing.view, settings.feature_channels,
                drawing.footprints, drawing.first_slots, drawing.slot_counts, moments, extras,
                settings.extra_width, c == 0, need_colors, need_camera, settings.absgrad, gradient_arrays,
                means2d_gradient[c].detach().numpy(), absgrad[c].detach().numpy(), camera_gradient,
            )  # fmt: skip
            if viewmats_gradient is not None:
                viewmats_gradient[c] = _viewmat_gradient(camera_gradient, viewmats[c])
        if settings.absgrad:
            ctx.means2d.absgrad = absgrad
        backgrounds_gradient = None
        if need_background:
            # numpy's sum, unlike torch's, does not depend on the number of threads.
            weighted = (images_gradient.double() * transmittances.double()[..., None]).numpy()
            backgrounds_gradient = torch.from_numpy(weighted.sum((1, 2))).float()
        returned = (*gradients, viewmats_gradient, backgrounds_gradient, means2d_gradient, None, None, None)
        return tuple(
            gradient if needed else None
            for gradient, needed in zip(returned, ctx.needs_input_grad, strict=True)
        )


def _empty(*shape: int, dtype: Any = np.float32) -> Tensor:
    """An uninitialised tensor in memory that is used again."""
    return torch.from_numpy(memory.empty(shape, dtype))


def _draw(
    gaussians: GaussianArrays,
    view: ViewSettings,
    background: Array,
    settings: Settings,
    for_backward: bool,
    means2d: Array,
    depths: Array,
    radii: Array,
    image: Array,
    alpha: Array,
    transmittance: Array,
) -> Drawing:
    """One camera's forward pass; fills the last six arrays."""
    count = len(gaussians.means)
    width, height = settings.width, settings.height
    columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)

    footprints = memory.empty((count, PACKED), np.float32)
    features = memory.empty((count, settings.feature_channels), np.float32)
    slot_counts = memory.empty((count,), np.int32)  # at first a bound
    projected = ProjectedArrays(footprints, features, means2d, depths, radii, slot_counts)
    run(projection.project, gaussians, view, projected)
    order, spare_order = (memory.empty((count,), np.int32) for _ in range(2))
    keys, spare_keys = (memory.empty((count,), np.uint32) for _ in range(2))
    visible = binning.sort_by_depth(depths, order, spare_order, keys, spare_keys)
    order = order[:visible]

    shares = 4 * torch.get_num_threads() if torch.get_num_threads() > 1 else 1
    starts = memory.empty((shares + 1,), np.int64)
    binning.share_bounds(order, slot_counts, starts)
    most_pairs = int(starts[-1])
    if most_pairs >= MAX_PAIRS:
        raise BackendError(
            f"{visible} Gaussians cover {most_pairs} tiles together, more than the CPU rasterizer can list "
            f"({MAX_PAIRS}): render fewer or smaller Gaussians, or at a lower resolution"
        )
    tiles = memory.empty((most_pairs + 1,), np.int32)
    rows_of_pairs = memory.empty((most_pairs + 1,), np.int16)
    cursors = memory.empty((shares, columns * rows), np.int64)
    run(
        binning.list_pairs, footprints, order, columns, height, starts, tiles, rows_of_pairs, slot_counts,
        cursors,
    )  # fmt: skip
    tile_starts = memory.empty((columns * rows + 1,), np.int64)
    first_slots = memory.empty((count if for_backward else 0,), np.int32)
    pairs = binning.offsets_from_counts(cursors, tile_starts, slot_counts, first_slots)
    entries = memory.empty((pairs,), np.int64)
    entry_slots = memory.empty((pairs if for_backward else 0,), np.int32)
    run(
        binning.sort_pairs, order, starts, tiles, rows_of_pairs, slot_counts, first_slots, cursors, entries,
        entry_slots,
    )  # fmt: skip
    ends = memory.empty((columns * rows,), np.int64)
    own_colors = features if settings.feature_channels else None
    run(
        blending.blend, footprints, own_colors, entries, tile_starts, columns, background, image, alpha,
        transmittance, ends,
    )  # fmt: skip
    return Drawing(
        view, footprints, own_colors, first_slots, slot_counts, tile_starts, entries, entry_slots, ends
    )


def _blend_backward(
    drawing: Drawing,
    image: Array,
    transmittance: Array,
    image_gradient: Array,
    alpha_gradient: Array,
    settings: Settings,
) -> tuple[Array, Array]:
    """The sums over each (Gaussian, tile) pair: [slots * MOMENTS] and [slots * extra_width], see `layout`."""
    slots = len(drawing.entries)
    moments = memory.empty((slots * MOMENTS,), np.float32)
    extras = memory.empty((slots * settings.extra_width,), np.float32)
    run(
        blending_backward.blend_backward, drawing.footprints, drawing.features, drawing.entries,
        drawing.entry_slots, drawing.tile_starts, drawing.ends, -(-settings.width // TILE_WIDTH), image,
        transmittance, image_gradient, alpha_gradient, moments, extras, settings.extra_width,
        settings.absgrad,
    )  # fmt: skip
    return moments, extras


def _camera_array(viewmat: Tensor, K: Tensor) -> Array:
    """The camera as the kernels want it, see `layout.CAMERA`."""
    view = viewmat.detach().double().numpy()
    intrinsics = K.detach().double().numpy()
    camera = memory.empty((CAMERA,), np.float32)
    camera[:TX] = view[:3, :3].ravel()
    camera[TX:FX] = view[:3, 3]
    camera[FX:POSITION] = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    camera[POSITION:] = -view[:3, :3].T @ view[:3, 3]
    return camera


def _viewmat_gradient(pieces: Array, viewmat: Tensor) -> Tensor:
    """[4, 4] from the sums that `project_backward` leaves, through position = -R^T t."""
    sums = pieces.sum(0)
    rotation, translation, position = sums[:9].reshape(3, 3), sums[9:12], sums[12:15]
    view = viewmat.detach().double().numpy()
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = rotation - np.outer(view[:3, 3], position)
    gradient[:3, 3] = translation - view[:3, :3] @ position
    return torch.from_numpy(gradient)
