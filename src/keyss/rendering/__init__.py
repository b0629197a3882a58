"""From Gaussians to pictures, differentiably: our own rasterizer on the CPU, gsplat on CUDA."""

from keyss.rendering.backends import Backend, resolve_device
from keyss.rendering.rasterize import rasterization
from keyss.rendering.view import render, render_with_meta

__all__ = ["Backend", "rasterization", "render", "render_with_meta", "resolve_device"]
