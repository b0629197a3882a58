"""From Gaussians to pictures, differentiably: our own rasterizer on the CPU, gsplat on CUDA."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.rendering.backends import Backend as Backend, resolve_device as resolve_device
    from keyss.rendering.decoding import (
        decode_picture as decode_picture,
        draw_features as draw_features,
    )
    from keyss.rendering.difference import Viewpoints as Viewpoints, psnr_between as psnr_between
    from keyss.rendering.orbit import (
        is_model as is_model,
        look_at as look_at,
        middle_and_radius as middle_and_radius,
        scene_of_model as scene_of_model,
    )
    from keyss.rendering.paths import around as around, circle as circle, through as through
    from keyss.rendering.rasterize import rasterization as rasterization
    from keyss.rendering.view import render as render, render_with_meta as render_with_meta
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.rendering.backends": ["Backend", "resolve_device"],
            "keyss.rendering.decoding": ["decode_picture", "draw_features"],
            "keyss.rendering.difference": ["Viewpoints", "psnr_between"],
            "keyss.rendering.orbit": ["is_model", "look_at", "middle_and_radius", "scene_of_model"],
            "keyss.rendering.paths": ["around", "circle", "through"],
            "keyss.rendering.rasterize": ["rasterization"],
            "keyss.rendering.view": ["render", "render_with_meta"],
        },
    )
