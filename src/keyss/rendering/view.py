"""One picture of `Gaussians` from one `Camera`."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from keyss.core import Camera, Gaussians
from keyss.core.decoded import DecodedGaussians
from keyss.rendering.decoding import decode_picture, draw_features
from keyss.rendering.rasterize import rasterization


def render(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None
) -> Tensor:
    """The picture [H, W, 3] that the camera takes; 0 is black, 1 is white, and it is not clamped above.

    `background` [3] lies behind everything, black when None. `sh_degree` limits the spherical harmonics
    (default: all that the Gaussians have). What a network decodes has a background of its own. Drawn on the
    device of the Gaussians; differentiable. Raises what `rasterization` raises.
    """
    return render_with_meta(gaussians, camera, background, sh_degree=sh_degree)[0]


def render_with_meta(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """Like `render`, with the meta of `rasterization` for this one camera and `alpha` [H, W] in it."""
    if isinstance(gaussians, DecodedGaussians):
        return _draw_decoded(gaussians, camera, sh_degree)
    device = gaussians.device
    images, alphas, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.viewmat.to(device)[None],
        camera.K.to(device)[None],
        camera.width,
        camera.height,
        sh_degree=gaussians.sh_degree if sh_degree is None else sh_degree,
        backgrounds=None if background is None else background.to(device)[None],
    )
    # Unlike an index, a squeezed axis costs no copy in the backward pass.
    return images.squeeze(0), meta | {"alpha": alphas.squeeze(0).squeeze(-1)}


def _draw_decoded(
    model: DecodedGaussians, camera: Camera, sh_degree: int | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """The picture [H, W, 3] and the meta of `rasterization`."""
    network = model.network
    if model.features is not None:
        drawn, meta = draw_features(model, model.features, camera, network.background)
    else:
        plain = Gaussians(model.means, model.quats, model.log_scales, model.opacity_logits, model.sh)
        drawn, meta = render_with_meta(plain, camera, network.background, sh_degree=sh_degree)
    return decode_picture(drawn, network), meta
