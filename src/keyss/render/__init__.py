"""From Gaussians to pictures, differentiably: our own rasterizer on the CPU, gsplat on CUDA."""

from keyss.render.backends import Backend, resolve_device
from keyss.render.rasterize import rasterization
from keyss.render.view import render, render_with_meta

__all__ = ["Backend", "rasterization", "render", "render_with_meta", "resolve_device"]
