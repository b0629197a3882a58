"""3DGS+Decoder: a network from the rendered cover to the secret (a baseline of GS-Hider and KeySS).

What is published is a 3DGS model of the cover, trained so that the network can tell the secret's picture from
its renders. The network is handed over; it is as large as one of GS-Hider's decoders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch

from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity
from keyss.fitting.parameters import to_gaussians
from keyss.methods.base import Capabilities
from keyss.methods.peers.joint import JointPeer
from keyss.methods.peers.networks import Convolutions, network_of, network_tensors, untrained
from keyss.methods.peers.options import PeerOptions, presets_of
from keyss.methods.peers.payload import HandedSecret, HandedTensors
from keyss.methods.peers.training import PeerRun, Picture
from keyss.methods.poses import PlacedScene
from keyss.rendering import render_with_meta
from keyss.rendering.decoding import decode_picture

NAME = "3dgs-decoder"


class DecoderRun(PeerRun):
    """Plain Gaussians, and a network."""

    def prepare(self, start: Gaussians) -> None:
        self.decoder = Convolutions(3)
        self.networks.append(self.decoder)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """The secret is made of the cover's picture, before the cover's background."""
        background = self.backgrounds[0]
        cover, meta = render_with_meta(to_gaussians(self.parameters), camera, background, sh_degree=sh_degree)
        network = self.decoder.network(background)
        return [(decode_picture(cover, network) if scene else cover, meta) for scene in scenes]


@dataclass(frozen=True, kw_only=True)
class DecoderOptions(PeerOptions):
    """The Gaussians show the cover only, so they start from its points."""

    points: Literal["both", "cover"] = "cover"


class DecoderMethod(JointPeer):
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "a network from the cover's picture to the secret's, handed over (baseline)"
    capabilities = Capabilities(keys=False, hands_over=True, models=False)
    options = DecoderOptions
    presets: Mapping[str, PeerOptions] = presets_of(DecoderOptions)
    networks = (None, untrained(3))

    def begin(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> DecoderRun:
        return DecoderRun(scenes, options, device)

    def publish(self, run: DecoderRun, frame: Similarity) -> tuple[Gaussians, HandedTensors]:
        kept = run.kept()
        stego = Gaussians(kept["means"], kept["quats"], kept["scales"], kept["opacities"], kept["sh"])
        return stego, HandedTensors(network_tensors(run.decoder.network(run.backgrounds[0])), frame)

    def open(self, handed: HandedTensors) -> HandedSecret:
        network = network_of(handed)
        if len(network.background) != 3:
            raise InputError("what was handed over is damaged: expected a network for pictures in colour")
        return HandedSecret(handed, lambda stego: DecodedGaussians.of(stego, network))
