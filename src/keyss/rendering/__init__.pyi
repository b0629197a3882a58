from .framing import Frame as Frame, frame_of as frame_of
from .orbit import (
    VIEWS as VIEWS,
    Viewpoints as Viewpoints,
    psnr_between as psnr_between,
    scene_of_model as scene_of_model,
)
from .rasterize import (
    Backend as Backend,
    contributions as contributions,
    decode_picture as decode_picture,
    rasterization as rasterization,
    render as render,
    render_features as render_features,
    render_with_meta as render_with_meta,
    resolve_device as resolve_device,
)
