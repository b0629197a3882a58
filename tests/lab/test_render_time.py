"""Rendering times beside a plain model."""

from __future__ import annotations

from keyss.lab import measure_render_time
from tiny_scenes import random_gaussians, tiny_scene


def test_ratio_of_equal_and_of_smaller_models() -> None:
    scene, model = tiny_scene(0, views=8), random_gaussians(4000)
    same = measure_render_time(model, model, scene, rounds=4)
    more = measure_render_time(model, model[:10], scene, rounds=4)
    assert 0 < same.seconds < 10
    assert 0.1 < same.ratio < 10
    assert more.ratio > same.ratio / 10
