"""The networks of GS-Hider (Zhang et al. 2024): five 3x3 convolutions, 64 wide, ReLU between them."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from keyss.core.decoded import PictureNetwork
from keyss.methods.peers.method import HandedTensors

WIDTH, LAYERS = 64, 5


class Convolutions(torch.nn.Module):
    """A network from images with so many channels to RGB."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        widths = [channels, *[WIDTH] * (LAYERS - 1), 3]
        self.layers = torch.nn.Sequential(
            *(torch.nn.Conv2d(before, after, 3) for before, after in pairwise(widths))
        )

    def network(self, background: Tensor) -> PictureNetwork:
        """The network for images with `background` [C]; attached to the graph."""
        weights = list(self.parameters())
        return PictureNetwork(tuple(zip(weights[::2], weights[1::2], strict=True)), background)


def weights_of(channels: int) -> int:
    """The number of weights of `Convolutions`, without biases."""
    return sum(9 * before * after for before, after in pairwise([channels, *[WIDTH] * (LAYERS - 1), 3]))


def network_tensors(network: PictureNetwork) -> dict[str, Tensor]:
    """The tensors of a network by name."""
    tensors = {"background": network.background}
    for index, (weight, bias) in enumerate(network.layers):
        tensors |= {f"weight.{index}": weight, f"bias.{index}": bias}
    return tensors


def network_of(handed: HandedTensors) -> PictureNetwork:
    """The network of `network_tensors`. Raises InputError, ValueError and TypeError for damage."""
    names = [f"{kind}.{index}" for index in range(LAYERS) for kind in ("weight", "bias")]
    background, *rest = handed.taken(["background", *names])
    return PictureNetwork(tuple(zip(rest[::2], rest[1::2], strict=True)), background)
