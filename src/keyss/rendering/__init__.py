"""Renders Gaussians differentiably: our own rasterizer on the CPU, gsplat on CUDA."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
