"""The same input gives the same bits: again, with more threads, from two threads at once, after a fork."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from keyss.rendering import rasterization
from rendering.toy_scenes import ToyScene, toy_scene


@pytest.fixture(autouse=True)
def _restore_threads() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def forward_and_backward(scene: ToyScene) -> list[Tensor]:
    """Image, alpha, radii and every gradient, for two cameras."""
    inputs = scene.tensors(torch.float32)
    viewmat = inputs[5]
    images, alphas, meta = rasterization(
        *inputs[:5],
        torch.stack([viewmat, viewmat @ viewmat]),
        scene.K.float().expand(2, 3, 3),
        scene.width,
        scene.height,
        sh_degree=scene.sh_degree,
        backgrounds=inputs[6].expand(2, -1),
        absgrad=True,
        render_mode=scene.render_mode,
        rasterize_mode=scene.rasterize_mode,
    )
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(images.shape, generator=generator)
    ((images * weights).sum() + (alphas * weights[..., :1]).sum()).backward()
    means2d = meta["means2d"]
    gradients = [tensor.grad for tensor in inputs]
    return [images, alphas, meta["radii"], means2d.detach(), means2d.grad, means2d.absgrad, *gradients]


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    "scene",
    [
        toy_scene(count=7000, width=150, height=130, size=0.05),
        toy_scene(count=7000, width=150, height=130, size=0.05, sh_degree=None, channels=7),
        toy_scene(3000, 150, 130, size=0.05, render_mode="RGB+ED", rasterize_mode="antialiased"),
    ],
    ids=["colour", "features", "antialiased colour and depth"],
)
def test_results_do_not_depend_on_the_run_or_the_number_of_threads(scene: ToyScene) -> None:
    torch.set_num_threads(1)
    expected = forward_and_backward(scene)
    assert all(tensor.isfinite().all() for tensor in expected)
    assert same(forward_and_backward(scene), expected)
    for threads in (2, 3):
        torch.set_num_threads(threads)
        for _ in range(2):
            assert same(forward_and_backward(scene), expected)


def test_python_threads_may_render_at_once() -> None:
    scenes = [toy_scene(count=2000, width=90, height=70, size=0.05, seed=seed) for seed in range(4)]
    torch.set_num_threads(2)
    expected = [forward_and_backward(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            results = list(pool.map(forward_and_backward, scenes))
            assert all(same(a, b) for a, b in zip(results, expected, strict=True))


def _draw(scene: ToyScene, inputs: list[Tensor]) -> float:
    with torch.no_grad():
        images, _, _ = rasterization(
            *inputs[:5], inputs[5][None], scene.K[None], scene.width, scene.height, sh_degree=3
        )
    return float(images.numpy().sum(dtype="float64"))


@pytest.mark.skipif(sys.platform != "linux", reason="fork is the default nowhere else")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_rendering_works_in_a_forked_child() -> None:
    # The scene is made before the fork, because torch's own threads do not survive it.
    scene = toy_scene(count=500, width=300, height=200)
    scene.K = scene.K.float()
    inputs = scene.tensors(torch.float32)
    torch.set_num_threads(2)
    expected = _draw(scene, inputs)
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.Queue[float] = context.Queue()
    child = context.Process(target=lambda: queue.put(_draw(scene, inputs)))
    child.start()
    try:
        assert queue.get(timeout=20) == expected
    finally:
        child.join(10)
        child.kill()
