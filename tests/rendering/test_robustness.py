"""Hostile numbers do no harm, and what should not matter does not."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from keyss.rendering import rasterization
from keyss.rendering.arguments import RASTERIZE_MODES, RENDER_MODES
from keyss.rendering.cpu import rasterization as cpu_rasterization
from rendering.toy_scenes import SCENES, toy_scene

HOSTILE = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-38, -1e-38, 1e15, -1e15, 1e30, -1e30, 3e38, 1.0)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_hostile_numbers_give_finite_images_and_gradients(data: st.DataObject) -> None:
    sh_degree = data.draw(st.sampled_from([None, 0, 3]))
    scene = toy_scene(
        count=12,
        width=21,
        height=35,
        size=0.3,
        sh_degree=sh_degree,
        channels=3 if sh_degree is not None else data.draw(st.sampled_from([1, 2, 3, 4, 11])),
        render_mode=data.draw(st.sampled_from(RENDER_MODES)),
        rasterize_mode=data.draw(st.sampled_from(RASTERIZE_MODES)),
        seed=data.draw(st.integers(0, 5)),
    )
    inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
    for _ in range(data.draw(st.integers(1, 8))):
        tensor = inputs[data.draw(st.integers(0, 4))].flatten()
        tensor[data.draw(st.integers(0, len(tensor) - 1))] = data.draw(st.sampled_from(HOSTILE))
    inputs = [tensor.requires_grad_() for tensor in inputs]
    images, alphas, meta = rasterization(
        *inputs[:5],
        inputs[5][None],
        scene.K.float()[None],
        21,
        35,
        sh_degree=sh_degree,
        absgrad=True,
        render_mode=scene.render_mode,
        rasterize_mode=scene.rasterize_mode,
    )
    assert images.isfinite().all()
    assert ((alphas >= 0) & (alphas <= 1)).all()
    (images.sum() + alphas.sum()).backward()
    hidden = (meta["radii"][0] == 0).any(-1)
    for tensor in inputs[: 5 if "RGB" in scene.render_mode else 4]:
        assert tensor.grad is not None
        assert (tensor.grad[hidden] == 0).all()


def test_one_bad_gaussian_leaves_the_rest_of_the_picture_as_it_was() -> None:
    scene = toy_scene()
    inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
    camera = (inputs[5][None], scene.K.float()[None], scene.width, scene.height)
    expected, _, _ = rasterization(*(t[1:] for t in inputs[:5]), *camera, sh_degree=3)
    for spoiled in range(5):
        for value in (math.nan, math.inf, -math.inf):
            bad = [tensor.clone() for tensor in inputs]
            bad[spoiled][0] = value
            images, _, meta = rasterization(*bad[:5], *camera, sh_degree=3)
            assert torch.equal(images, expected)
            assert (meta["radii"][0, 0] == 0).all()


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see_is_the_background(count: int) -> None:
    means = torch.tensor([[0.0, 0.0, -5.0]]).repeat(count, 1).requires_grad_()
    background = torch.tensor([[0.1, 0.2, 0.3]], requires_grad=True)
    images, alphas, meta = rasterization(
        means,
        torch.zeros(count, 4),
        torch.ones(count, 3),
        torch.ones(count),
        torch.ones(count, 3),
        torch.eye(4)[None],
        torch.eye(3)[None],
        9,
        5,
        backgrounds=background,
    )
    assert (images == background[0]).all()
    assert (alphas == 0).all()
    images.sum().backward()
    assert meta["means2d"].grad.shape == (1, count, 2)
    assert means.grad is not None
    assert (means.grad == 0).all()
    assert background.grad is not None
    assert background.grad.tolist() == [[45.0, 45.0, 45.0]]


def draw(
    inputs: list[Tensor], K: Tensor, width: int, height: int, **modes: Any
) -> tuple[Tensor, list[Tensor]]:
    """Image, and the gradients of the five attributes for a fixed loss."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    images, _, _ = rasterization(*leaves[:5], leaves[5][None], K[None], width, height, **modes)
    weights = torch.linspace(-1, 1, images.numel()).reshape(images.shape)
    (images * weights).sum().backward()
    gradients = [tensor.grad for tensor in leaves[:5]]
    return images.detach(), [gradient for gradient in gradients if gradient is not None]


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 10_000),
    st.integers(1, 5),
    st.sampled_from(["RGB", "RGB+ED"]),
    st.sampled_from(RASTERIZE_MODES),
)
def test_the_order_of_gaussians_does_not_matter(
    seed: int, channels: int, render_mode: str, rasterize_mode: str
) -> None:
    scene = toy_scene(sh_degree=None, channels=channels, seed=seed)
    modes = {"render_mode": render_mode, "rasterize_mode": rasterize_mode}
    inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
    permutation = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
    image, gradients = draw(inputs, scene.K.float(), scene.width, scene.height, **modes)
    shuffled = [tensor[permutation] for tensor in inputs[:5]] + inputs[5:]
    shuffled_image, shuffled_gradients = draw(shuffled, scene.K.float(), scene.width, scene.height, **modes)
    assert torch.equal(image, shuffled_image)
    for gradient, other in zip(gradients, shuffled_gradients, strict=True):
        assert torch.equal(gradient[permutation], other)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(RENDER_MODES), st.sampled_from(RASTERIZE_MODES))
def test_moving_world_and_camera_together_does_not_matter(
    seed: int, render_mode: str, rasterize_mode: str
) -> None:
    modes: Any = {"render_mode": render_mode, "rasterize_mode": rasterize_mode}
    generator = torch.Generator().manual_seed(seed)
    scene = toy_scene(sh_degree=None, seed=seed % 7)
    means, quats, scales, opacities, colors, viewmat, _ = (t.detach() for t in scene.tensors(torch.float64))
    w, *v = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    vector = torch.stack(v)
    cross = torch.zeros(3, 3, dtype=torch.float64)
    cross[[2, 0, 1], [1, 2, 0]] = vector
    cross[[1, 2, 0], [2, 0, 1]] = -vector
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.eye(3) + 2 * w * cross + 2 * cross @ cross
    motion[:3, 3] = torch.randn(3, generator=generator)
    moved_means = means @ motion[:3, :3].T + motion[:3, 3]
    real, imaginary = quats[:, :1], quats[:, 1:]
    moved_quats = torch.cat(
        [
            w * real - imaginary @ vector[:, None],
            w * imaginary + real * vector + torch.linalg.cross(vector.expand_as(imaginary), imaginary),
        ],
        dim=1,
    )
    rest = (scene.K[None], scene.width, scene.height)
    image, _, _ = rasterization(means, quats, scales, opacities, colors, viewmat[None], *rest, **modes)
    moved_view = viewmat @ torch.linalg.inv(motion)
    moved, _, _ = rasterization(
        moved_means, moved_quats, scales, opacities, colors, moved_view[None], *rest, **modes
    )
    different = (image - moved).abs().amax(-1) > 2e-4 * image.abs().max().clamp_min(1)
    assert different.float().mean() < 0.005  # a contribution of 1/255 may come or go by rounding


def test_strided_and_other_precisions_are_converted() -> None:
    scene = toy_scene()
    inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
    rest = (scene.K.float()[None], scene.width, scene.height)
    expected, _, _ = rasterization(*inputs[:5], inputs[5][None], *rest, sh_degree=3)
    strided = [torch.stack([tensor, tensor], -1)[..., 0].requires_grad_() for tensor in inputs]
    images, _, _ = rasterization(*strided[:5], strided[5][None], *rest, sh_degree=3)
    assert torch.equal(images, expected)
    double = [tensor.double().requires_grad_() for tensor in inputs]
    images, _, _ = rasterization(*double[:5], double[5][None], *rest, sh_degree=3)
    assert torch.equal(images, expected)
    images.sum().backward()
    assert all(tensor.grad is not None and tensor.grad.dtype == torch.float64 for tensor in double[:6])


def test_several_cameras_are_the_sum_of_single_ones() -> None:
    scene = toy_scene()
    K = scene.K.float()
    views = [scene.viewmat.float(), scene.viewmat.float() @ scene.viewmat.float()]
    together = scene.tensors(torch.float32)
    images, _, meta = rasterization(
        *together[:5], torch.stack(views), K.expand(2, 3, 3), scene.width, scene.height, sh_degree=3
    )
    images.square().sum().backward()
    apart = scene.tensors(torch.float32)
    for c, view in enumerate(views):
        image, _, single = rasterization(
            *apart[:5], view[None], K[None], scene.width, scene.height, sh_degree=3
        )
        image.square().sum().backward()
        assert torch.equal(image[0], images[c])
        assert torch.equal(single["radii"][0], meta["radii"][c])
        assert torch.equal(single["means2d"].grad[0], meta["means2d"].grad[c])
    for one, other in zip(together[:5], apart[:5], strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-5, atol=1e-5)


def test_only_wanted_gradients_are_made() -> None:
    scene = toy_scene()
    for wanted in range(5):
        inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
        inputs[wanted].requires_grad_()
        images, _, meta = rasterization(
            *inputs[:5], inputs[5][None], scene.K.float()[None], scene.width, scene.height, sh_degree=3
        )
        images.sum().backward()
        assert [tensor.grad is not None for tensor in inputs[:5]] == [i == wanted for i in range(5)]
        assert meta["means2d"].requires_grad == (wanted != 4)
    with torch.no_grad():
        inputs = scene.tensors(torch.float32)
        images, _, meta = rasterization(
            *inputs[:5], inputs[5][None], scene.K.float()[None], scene.width, scene.height, sh_degree=3
        )
        assert not images.requires_grad
        assert not meta["means2d"].requires_grad


def test_features_are_drawn_like_colours() -> None:
    scene = toy_scene(sh_degree=None, channels=5)
    drawn = {}
    for channels in ([0, 1, 2, 3, 4], [0, 1, 2], [2, 3, 4]):
        inputs = [tensor.detach() for tensor in scene.tensors(torch.float32)]
        inputs[4] = inputs[4][:, channels]
        inputs[6] = inputs[6][channels]
        drawn[tuple(channels)] = rasterization(
            *inputs[:5],
            inputs[5][None],
            scene.K.float()[None],
            scene.width,
            scene.height,
            backgrounds=inputs[6][None],
        )
    images, alphas, _ = drawn.pop((0, 1, 2, 3, 4))
    for chosen, (some, same_alphas, _) in drawn.items():
        torch.testing.assert_close(some, images[..., list(chosen)], rtol=0, atol=1e-6)
        torch.testing.assert_close(same_alphas, alphas, rtol=0, atol=1e-6)


def test_alpha_alone_has_gradients() -> None:
    scene = SCENES["random"]()
    inputs = scene.tensors(torch.float32)
    _, alphas, _ = rasterization(
        *inputs[:5], inputs[5][None], scene.K.float()[None], scene.width, scene.height, sh_degree=3
    )
    alphas.sum().backward()
    assert inputs[3].grad is not None
    assert (inputs[3].grad > 0).any()
    assert inputs[4].grad is not None
    assert (inputs[4].grad == 0).all()


def test_too_many_tiles_are_an_error_not_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_rasterization, "MAX_PAIRS", 3)
    scene = toy_scene()
    inputs = scene.tensors(torch.float32)
    with pytest.raises(cpu_rasterization.BackendError, match="tiles together"):
        rasterization(*inputs[:5], inputs[5][None], scene.K.float()[None], 48, 40, sh_degree=3)
