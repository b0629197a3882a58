"""GS-Hider (Zhang et al., NeurIPS 2024): coupled features in place of harmonics, and two networks.

The Gaussians' 16 features are drawn like colours. A scene decoder, which is published with them, makes the
cover's picture of what was drawn, and a message decoder, which is handed over, the secret's. No viewer of
3DGS models shows either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity
from keyss.methods.base import Capabilities
from keyss.methods.peers.joint import JointPeer
from keyss.methods.peers.networks import Convolutions, network_of, network_tensors, untrained
from keyss.methods.peers.options import PeerOptions, presets_of
from keyss.methods.peers.payload import HandedSecret, HandedTensors
from keyss.methods.peers.training import PeerRun, Picture
from keyss.methods.poses import PlacedScene
from keyss.rendering.decoding import decode_picture, draw_features

NAME = "gs-hider"
FEATURES = 16
_NOISE = 0.1  # standard deviation of the features that begin as nothing


class GsHiderRun(PeerRun):
    """Features instead of harmonics, a scene decoder and a message decoder."""

    def prepare(self, start: Gaussians) -> None:
        """Three features begin as the points' colours, the others as noise."""
        del self.parameters["sh"], self.optimizers["sh"]
        noise = _NOISE * torch.randn(len(start), FEATURES - 3)
        self.add("features", torch.cat([SH_C0 * start.sh[:, 0], noise], 1), self.options.fit.sh0_rate)
        self.decoders = (Convolutions(FEATURES), Convolutions(FEATURES))  # of the scene, of the message
        self.networks.extend(self.decoders)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """All from one drawing of the features."""
        behind = torch.zeros(FEATURES, device=self.device)
        drawn, meta = draw_features(self._gaussians(), self.parameters["features"], camera, behind)
        return [(decode_picture(drawn, self.decoders[scene].network(behind)), meta) for scene in scenes]

    def _gaussians(self) -> Gaussians:
        return Gaussians(
            **self.geometry(),
            opacity_logits=self.parameters["opacities"],
            sh=torch.zeros(len(self), 1, 3, device=self.device),
        )


@dataclass(frozen=True, kw_only=True)
class GsHiderOptions(PeerOptions):
    """See `PeerOptions`."""


class GsHiderMethod(JointPeer):
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "features in place of harmonics, and a network for each scene"
    capabilities = Capabilities(keys=False, hands_over=True, standard=False, models=False)
    options = GsHiderOptions
    presets: Mapping[str, PeerOptions] = presets_of(GsHiderOptions)
    networks = (untrained(FEATURES),) * 2

    def begin(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> GsHiderRun:
        return GsHiderRun(scenes, options, device)

    def publish(self, run: GsHiderRun, frame: Similarity) -> tuple[Gaussians, HandedTensors]:
        kept = run.kept()
        behind = torch.zeros(FEATURES)
        cover, secret = (
            each.network(behind.to(run.device)).map(lambda values: values.detach().cpu())
            for each in run.decoders
        )
        plain = Gaussians(
            kept["means"],
            kept["quats"],
            kept["scales"],
            kept["opacities"],
            torch.zeros(len(kept["means"]), 1, 3),
        )
        stego = DecodedGaussians.of(plain, cover, kept["features"])
        return stego, HandedTensors(network_tensors(secret), frame)

    def open(self, handed: HandedTensors) -> HandedSecret:
        network = network_of(handed)

        def show(stego: Gaussians) -> Gaussians:
            try:
                if not isinstance(stego, DecodedGaussians) or stego.features is None:
                    raise InputError("expected the model that gs-hider published, which has features")
                return DecodedGaussians.of(stego, network, stego.features)
            except ValueError as error:
                raise InputError(f"what was handed over does not fit: {error}") from error

        return HandedSecret(handed, show)
