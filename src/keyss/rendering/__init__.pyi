from .backends import Backend as Backend, resolve_device as resolve_device
from .decoding import decode_picture as decode_picture, draw_features as draw_features
from .difference import Viewpoints as Viewpoints, psnr_between as psnr_between
from .orbit import (
    is_model as is_model,
    look_at as look_at,
    middle_and_radius as middle_and_radius,
    scene_of_model as scene_of_model,
)
from .paths import around as around, circle as circle, through as through
from .rasterize import rasterization as rasterization
from .view import render as render, render_with_meta as render_with_meta
