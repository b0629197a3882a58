"""Models decoded by a network: rendering, transforms, files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from keyss.core import DecodedGaussians, PictureNetwork, Similarity, UsageError
from keyss.files import DECODED_SUFFIX, read_model, write_model
from keyss.rendering import rasterization, render
from tiny_scenes import random_gaussians, ring_cameras

CHANNELS = 5


def network(channels: int = CHANNELS, widths: tuple[int, ...] = (8, 3)) -> PictureNetwork:
    generator = torch.Generator().manual_seed(7)
    layers, before = [], channels
    for width in widths:
        weight = 0.3 * torch.randn(width, before, 3, 3, generator=generator)
        layers.append((weight, torch.randn(width, generator=generator)))
        before = width
    return PictureNetwork(tuple(layers), torch.rand(channels, generator=generator))


@pytest.fixture
def model() -> DecodedGaussians:
    features = torch.randn(50, CHANNELS, generator=torch.Generator().manual_seed(3))
    return DecodedGaussians.of(random_gaussians(50, sh_degree=1), network(), features)


def convolve(image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A zero-padded 3x3 convolution over [H, W, C] as nine sums."""
    height, width, _ = image.shape
    padded = torch.zeros(height + 2, width + 2, image.shape[2])
    padded[1:-1, 1:-1] = image
    out = bias.expand(height, width, -1).clone()
    for y in range(3):
        for x in range(3):
            out += padded[y : y + height, x : x + width] @ weight[:, :, y, x].T
    return out


def test_render(model: DecodedGaussians) -> None:
    camera = ring_cameras()[3]
    assert model.features is not None
    drawn, _, _ = rasterization(
        model.means,
        model.quats,
        model.scales,
        model.opacities,
        model.features,
        camera.viewmat,
        camera.K,
        camera.width,
        camera.height,
        background=model.network.background,
    )
    (first, second) = model.network.layers
    expected = convolve(convolve(drawn, *first).relu(), *second)
    torch.testing.assert_close(render(model, camera), expected, atol=1e-4, rtol=1e-4)


def test_transforms_keep_network(model: DecodedGaussians) -> None:
    camera = ring_cameras()[3]
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0]]).double())
    frame = Similarity(1.7, turn, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    moved = frame.apply_gaussians(model)
    torch.testing.assert_close(
        render(moved, frame.apply_camera(camera)), render(model, camera), atol=2e-3, rtol=1e-3
    )
    some = model[torch.arange(50) % 2 == 0].with_sh_degree(0).to("cpu").detach()
    assert isinstance(some, DecodedGaussians)
    assert some.features is not None
    assert (len(some), len(some.features)) == (25, 25)
    assert model.features is not None
    assert DecodedGaussians.of(model, network(), -model.features).digest() != model.digest()


def test_file_round_trip(model: DecodedGaussians, tmp_path: Path) -> None:
    path = tmp_path / f"a{DECODED_SUFFIX}"
    write_model(path, model)
    again = read_model(path)
    assert isinstance(again, DecodedGaussians)
    assert again.digest() == model.digest()
    with pytest.raises(UsageError, match="network"):
        write_model(tmp_path / "a.ply", model)
    with pytest.raises(UsageError, match="network"):
        write_model(tmp_path / f"b{DECODED_SUFFIX}", random_gaussians(10))
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
