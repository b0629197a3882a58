"""Arrays and numbers that kernels are given together, by name."""

from __future__ import annotations

from typing import Any, NamedTuple

Array = Any  # a numpy array here; kernels see numba's types


class GaussianArrays(NamedTuple):
    """N Gaussians, or gradients of the same shapes."""

    means: Array  # [N, 3]
    quats: Array  # [N, 4]
    scales: Array  # [N, 3]
    opacities: Array  # [N]
    colors: Array  # [N, K, 3] SH coefficients; [N, 1, channels] where sh_count is 0


class ViewSettings(NamedTuple):
    """One camera, and what is drawn of what it sees; see `keyss.rendering.rasterization`."""

    camera: Array  # [CAMERA], see `layout`
    width: int
    height: int
    near: Any  # these four are float32
    far: Any
    eps2d: Any
    radius_clip: Any
    antialiased: bool
    sh_count: int  # SH coefficients to use; 0 where colors[:, 0] is the colour itself


class ProjectedArrays(NamedTuple):
    """What `projection.project` finds of N Gaussians."""

    footprints: Array  # [N, PACKED], see `layout`
    # [N, channels] the channels to draw: the colour, and in one column more the depth. No columns where the
    # colour is drawn from the footprints.
    features: Array
    means2d: Array  # [N, 2] pixels
    depths: Array  # [N]; 0 of what is not drawn
    radii: Array  # [N, 2] int32, pixels; 0 of what is not drawn
    tile_bounds: Array  # [N] int32, tiles that the Gaussian meets at most
