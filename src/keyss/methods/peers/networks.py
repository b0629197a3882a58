"""The networks of GS-Hider (Zhang et al. 2024): five 3x3 convolutions, 64 wide, ReLU between them."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from keyss.core.decoded import PictureNetwork
from keyss.core.errors import InputError
from keyss.methods.peers.payload import HandedTensors

WIDTH, LAYERS = 64, 5


class Convolutions(torch.nn.Module):
    """From pictures of so many channels to RGB."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        widths = [channels, *[WIDTH] * (LAYERS - 1), 3]
        self.layers = torch.nn.Sequential(
            *(torch.nn.Conv2d(before, after, 3) for before, after in pairwise(widths))
        )

    def network(self, background: Tensor) -> PictureNetwork:
        """As what is drawn before `background` [C] goes through it; attached to the graph."""
        weights = list(self.parameters())
        return PictureNetwork(tuple(zip(weights[::2], weights[1::2], strict=True)), background)


def untrained(channels: int) -> PictureNetwork:
    """One of that size, which shows nothing."""
    widths = [channels, *[WIDTH] * (LAYERS - 1), 3]
    layers = tuple(
        (torch.zeros(after, before, 3, 3), torch.zeros(after)) for before, after in pairwise(widths)
    )
    return PictureNetwork(layers, torch.zeros(channels))


def network_tensors(network: PictureNetwork) -> dict[str, Tensor]:
    """By names, to be handed over."""
    tensors = {"background": network.background}
    for index, (weight, bias) in enumerate(network.layers):
        tensors |= {f"weight.{index}": weight, f"bias.{index}": bias}
    return tensors


def network_of(handed: HandedTensors) -> PictureNetwork:
    """What `network_tensors` gave. Raises InputError for damage."""
    names = [f"{kind}.{index}" for index in range(LAYERS) for kind in ("weight", "bias")]
    background, *rest = handed.taken(["background", *names])
    try:
        return PictureNetwork(tuple(zip(rest[::2], rest[1::2], strict=True)), background)
    except (ValueError, TypeError) as error:
        raise InputError(f"what was handed over is damaged: {error}") from error
