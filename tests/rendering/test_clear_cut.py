"""Close calls are found and removed, which other tests rely on."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from rendering.clear_cut import clear_cut, close_calls
from rendering.scenes import Scene, random_scene


def one_gaussian() -> Scene:
    """In the middle of a pixel, where its alpha is its opacity."""
    scene = random_scene(count=2, width=9, height=9, sh_degree=0)
    scene.means = torch.tensor([[0.0, 0, 2], [0, 0, 3]])
    scene.viewmats = torch.eye(4)[None]
    scene.Ks = torch.tensor([[[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]]])
    scene.scales[:] = 0.2
    scene.colors[:] = 0.1
    scene.opacities[:] = 0.5
    scene.round()
    return scene


def faint(scene: Scene) -> None:
    scene.opacities[0] = (1 + 1e-4) / 255


def clamped(scene: Scene) -> None:
    scene.opacities[0] = 0.99905


def stopping(scene: Scene) -> None:
    scene.opacities[:] = 1 - 0.01 * (1 + 1e-5)


def near(scene: Scene) -> None:
    scene.means[0, 2] = scene.near_plane * (1 + 1e-5)


def at_one_depth(scene: Scene) -> None:
    scene.means[0, 2] = 3 + 1e-6


def black(scene: Scene) -> None:
    scene.colors[0, 0, 1] = -0.5 / 0.28209479


def aside(scene: Scene) -> None:
    scene.means[0, 0] = 2 * (0.45 + 0.15 * 0.9)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("alpha 1/255", faint),
        ("alpha 0.999", clamped),
        ("transmittance", stopping),
        ("near plane", near),
        ("order", at_one_depth),
        ("black", black),
        ("the view where the perspective is linearised", aside),
    ],
)
def test_close_calls_are_found_and_resolved(name: str, spoil: Callable[[Scene], None]) -> None:
    scene = one_gaussian()
    assert not close_calls(scene)
    spoil(scene)
    scene.round()
    assert list(close_calls(scene)) == [name]
    assert not close_calls(clear_cut(scene))


def test_ties_that_no_rounding_can_break_are_no_close_calls() -> None:
    scene = one_gaussian()
    scene.means[1] = scene.means[0]
    assert not close_calls(scene)
    scene.means[0, 2] = scene.near_plane
    assert not close_calls(scene)
