"""3DGS+Decoder: a network from the rendered cover to the secret (a baseline of GS-Hider and KeySS).

The published model is a 3DGS model of the cover, trained jointly with a network that maps its renders to the
secret's images. The network is a companion file; it has the size of one of GS-Hider's decoders.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians, PictureNetwork
from keyss.core.scene import Camera
from keyss.fitting.parameters import to_gaussians
from keyss.lab.baselines.baseline import Baseline, BaselineTraining, CompanionTensors, Show
from keyss.lab.baselines.baseline_options import DecoderOptions
from keyss.methods.keyss.training import Picture
from keyss.methods.method import Capabilities
from keyss.rendering import decode_picture

WIDTH, LAYERS = 64, 5


class Convolutions(torch.nn.Module):
    """Convolutions from images with `channels` to RGB."""

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


class DecoderTraining(BaselineTraining):
    """The training of plain Gaussians and a network."""

    def prepare(self, start: Gaussians) -> None:
        self.network = Convolutions(3)
        self.networks.append(self.network)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """Render the cover with its background; the network maps the render to the secret's image."""
        cover = self.render(to_gaussians(self.parameters), 0, camera, sh_degree)
        network = self.network.network(self.backgrounds[0])
        return [
            Picture(decode_picture(cover.image, network), cover.meta) if scene else cover for scene in scenes
        ]

    def result(self) -> tuple[Gaussians, CompanionTensors]:
        network = self.network.network(self.backgrounds[0])
        stego = to_gaussians(self.parameters).detach()[self.visible()].to("cpu")
        return stego, CompanionTensors(network.tensors(), self.scenes[1].frame)


def _open(companion: CompanionTensors) -> Show:
    network = PictureNetwork.of(companion.tensors)
    return lambda stego: DecodedGaussians.of(stego, network)


METHOD = Baseline(
    options=DecoderOptions, capabilities=Capabilities(keys=False), open=_open, training=DecoderTraining
)
