"""Invalid input gives finite results or an error that names the argument; invariances hold.

Inputs lie between NaN in memory, which reveals reads out of bounds.
"""

from __future__ import annotations

import math
from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import assume, given, settings
from torch import Tensor

from keyss.rendering import rasterization
from rendering.scenes import CAMERA, DIFFERENTIABLE, random_scene

HOSTILE = (
    *(math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-45, -1e-40, 1e-38, -1e-12, 1e-6),
    *(1e3, -1e3, 1e8, 1e15, -1e15, 1e19, -1e25, 1e30, -1e30, 3.4e38, -3.4e38, 1.0),
)
GAUSSIAN = ("means", "quats", "scales", "opacities", "colors")


# SH degree or number of channels.
colors = st.one_of(
    st.fixed_dictionaries({"sh_degree": st.integers(0, 3)}),
    st.fixed_dictionaries({"sh_degree": st.none(), "channels": st.sampled_from([1, 2, 3, 4, 11, 32])}),
)


def guarded(tensor: Tensor) -> Tensor:
    """A contiguous copy with NaN before and behind it in memory."""
    memory = torch.full((tensor.numel() + 128,), math.nan, dtype=tensor.dtype)
    inside = memory[64 : 64 + tensor.numel()].view(tensor.shape)
    return inside.copy_(tensor)


def check_finite(results: dict[str, Tensor]) -> None:
    for name, tensor in results.items():
        if name != "means2d":  # may overflow far outside the image
            assert tensor.isfinite().all(), name
    assert ((results["alpha"] >= 0) & (results["alpha"] <= 1)).all()
    hidden = (results["radii"] == 0).any(-1)
    assert (results["gradient of means2d"][hidden] == 0).all()
    unseen = hidden.all(0)
    for name in GAUSSIAN:
        assert (results[f"gradient of {name}"][unseen] == 0).all(), name


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_hostile_gaussians(data: st.DataObject) -> None:
    scene = random_scene(
        count=data.draw(st.sampled_from([0, 1, 12])),
        width=data.draw(st.integers(1, 40)),
        height=data.draw(st.integers(1, 40)),
        size=0.3,
        seed=data.draw(st.integers(0, 5)),
        **data.draw(colors),
    )
    leaves = {name: guarded(leaf.detach()) for name, leaf in scene.leaves().items()}
    for _ in range(data.draw(st.integers(1, 10)) if len(scene.means) else 0):
        numbers = leaves[data.draw(st.sampled_from(GAUSSIAN))].view(-1)
        numbers[data.draw(st.integers(0, len(numbers) - 1))] = data.draw(st.sampled_from(HOSTILE))
    check_finite(scene.results({name: leaf.requires_grad_() for name, leaf in leaves.items()}))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("size", [1e14, 1e15, 1e16, 1e18])
def test_huge_needles(seed: int, size: float) -> None:
    scene = random_scene(count=1, width=1, height=1, size=0.3, seed=seed, sh_degree=0)
    leaves = {name: leaf.detach().clone() for name, leaf in scene.leaves().items()}
    leaves["means"][0, 2], leaves["opacities"][0], leaves["scales"][0, 0] = 1e8, 1e8, size
    check_finite(scene.results({name: leaf.requires_grad_() for name, leaf in leaves.items()}))


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_hostile_cameras(data: st.DataObject) -> None:
    scene = random_scene(count=12, width=21, height=35, size=0.3, **data.draw(colors))
    arguments = {name: guarded(leaf.detach()) for name, leaf in scene.leaves().items()}
    arguments |= {name: guarded(getattr(scene, name).float()) for name in CAMERA}
    spoiled = data.draw(st.lists(st.sampled_from(["viewmat", "K", "background"]), min_size=1, max_size=3))
    for name in spoiled:
        numbers = arguments[name].view(-1)
        numbers[data.draw(st.integers(0, len(numbers) - 1))] = data.draw(st.sampled_from(HOSTILE))
    leaves = {name: arguments[name].requires_grad_() for name in DIFFERENTIABLE}
    message, results = "", {}
    try:
        results = scene.results(leaves, **{name: arguments[name] for name in CAMERA})
    except ValueError as error:
        message = str(error)
    if message:
        assert any(message.startswith(f"{name}:") for name in spoiled)
    else:
        check_finite(results)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_wrong_shapes(data: st.DataObject) -> None:
    scene = random_scene(count=4, sh_degree=data.draw(st.sampled_from([None, 2])))
    camera = {name: getattr(scene, name).float() for name in CAMERA}
    arguments: dict[str, Any] = {**scene.leaves(), **camera, **scene.settings()}
    name = data.draw(st.sampled_from((*DIFFERENTIABLE, *CAMERA)))
    right = tuple(arguments[name].shape)
    shape = list(data.draw(st.one_of(st.permutations(right), st.lists(st.integers(0, 5), max_size=4))))
    if data.draw(st.booleans()):
        shape = [*right, 1] if data.draw(st.booleans()) else [1, *right]
    assume(tuple(shape) != right)
    if name == "colors":  # any number of channels or coefficients is valid
        assume(not (len(shape) == len(right) and shape[0] == right[0]))
    arguments[name] = torch.zeros(shape)
    with pytest.raises(ValueError, match="expected") as refused:
        rasterization(**arguments)
    message = str(refused.value)
    if name == "means" and shape[:1] != list(right[:1]):  # any of the arguments may be named
        assert any(message.startswith(f"{other}:") for other in arguments)
    else:
        assert message.startswith(f"{name}:")
        assert str(shape) in message


@settings(max_examples=25, deadline=None, derandomize=True)  # rounding errors have no bound over all seeds
@given(st.integers(0, 10_000), colors)
def test_permutation_invariance(seed: int, colors: Any) -> None:
    scene = random_scene(count=150, seed=seed, **colors)
    shuffle = torch.randperm(150, generator=torch.Generator().manual_seed(seed))
    results = scene.results()
    depths = results["depths"][results["depths"] > 0]
    assume(len(depths.unique()) == len(depths))
    leaves = {
        name: (leaf.detach()[shuffle] if name in GAUSSIAN else leaf.detach()).requires_grad_()
        for name, leaf in scene.leaves().items()
    }
    for name, tensor in scene.results(leaves).items():
        expected = results[name]
        if name.removeprefix("gradient of ") in GAUSSIAN:
            expected = expected[shuffle]
        elif name in ("radii", "depths", "means2d", "gradient of means2d"):
            expected = expected[:, shuffle]
        scale = max(1.0, float(expected.abs().max()))
        assert (tensor - expected).abs().max() <= 1e-6 * scale, name


def test_non_finite_gaussians_are_skipped() -> None:
    scene = random_scene()
    leaves = {name: leaf.detach() for name, leaf in scene.leaves().items()}
    without = {name: leaf[1:] if name in GAUSSIAN else leaf for name, leaf in leaves.items()}
    expected, _, _ = scene.draw(without)
    for spoiled in GAUSSIAN:
        for value in (math.nan, math.inf, -math.inf):
            bad = {**leaves, spoiled: leaves[spoiled].clone()}
            bad[spoiled][0] = value
            image, _, meta = scene.draw(bad)
            assert torch.equal(image, expected)
            assert (meta["radii"][0, 0] == 0).all()


@pytest.mark.parametrize("count", [0, 3])
def test_empty_scene_is_background(count: int) -> None:
    means = torch.tensor([[0.0, 0.0, -5.0]]).repeat(count, 1).requires_grad_()
    background = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    image, alpha, meta = rasterization(
        means,
        torch.zeros(count, 4),
        torch.ones(count, 3),
        torch.ones(count),
        torch.ones(count, 3),
        torch.eye(4),
        torch.eye(3),
        9,
        5,
        background=background,
    )
    assert (image == background).all()
    assert (alpha == 0).all()
    image.sum().backward()
    assert meta["means2d"].grad.shape == (1, count, 2)
    assert means.grad is not None
    assert (means.grad == 0).all()
    assert background.grad is not None
    assert background.grad.tolist() == [45.0, 45.0, 45.0]
