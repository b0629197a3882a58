"""GS-Hider (Zhang et al., NeurIPS 2024): coupled features in place of harmonics, and two networks.

The Gaussians' 16 features are rendered like colours. A published scene decoder maps rendered features to the
cover's image, a message decoder in a companion file to the secret's. Viewers of 3DGS models show neither.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.picture_network import DecodedGaussians, PictureNetwork
from keyss.core.scene import Camera
from keyss.lab.baselines.baseline import Baseline, BaselineTraining, CompanionTensors, Show
from keyss.lab.baselines.baseline_options import GsHiderOptions
from keyss.lab.baselines.picture_decoder import Convolutions
from keyss.methods.keyss.training import Picture
from keyss.methods.method import Capabilities
from keyss.rendering import decode_picture, render_features

FEATURES = 16
_NOISE = 0.1  # standard deviation of the features that start as noise


class GsHiderTraining(BaselineTraining):
    """The training of features instead of harmonics, a scene decoder and a message decoder."""

    def prepare(self, start: Gaussians) -> None:
        """Three features start as the points' colours, the others as noise."""
        del self.parameters["sh"], self.optimizers["sh"]
        noise = _NOISE * torch.randn(len(start), FEATURES - 3)
        self.add("features", torch.cat([SH_C0 * start.sh[:, 0], noise], 1), self.options.fit.sh0_rate)
        self.decoders = (Convolutions(FEATURES), Convolutions(FEATURES))  # scene, message
        self.networks.extend(self.decoders)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """All images come from one render of the features."""
        background = torch.zeros(FEATURES, device=self.device)
        image, meta = render_features(self.gaussians(), self.parameters["features"], camera, background)
        networks = (self.decoders[scene].network(background) for scene in scenes)
        return [Picture(decode_picture(image, network), meta) for network in networks]

    def gaussians(self) -> Gaussians:
        """The Gaussians, without colours."""
        parameters = self.parameters
        sh = torch.zeros(len(self), 1, 3, device=self.device)
        return Gaussians(
            parameters["means"], parameters["quats"], parameters["scales"], parameters["opacities"], sh
        )

    def result(self) -> tuple[Gaussians, CompanionTensors]:
        visible = self.visible()
        background = torch.zeros(FEATURES, device=self.device)
        cover, secret = (
            decoder.network(background).map(lambda values: values.detach().cpu()) for decoder in self.decoders
        )
        features = self.parameters["features"].detach()[visible].cpu()
        stego = DecodedGaussians.of(self.gaussians().detach()[visible].to("cpu"), cover, features)
        return stego, CompanionTensors(secret.tensors(), self.scenes[1].frame)


def _open(companion: CompanionTensors) -> Show:
    network = PictureNetwork.of(companion.tensors)

    def show(stego: Gaussians) -> Gaussians:
        if not isinstance(stego, DecodedGaussians) or stego.features is None:
            raise InputError("expected the model that gs-hider published, which has features")
        return DecodedGaussians.of(stego, network, stego.features)

    return show


METHOD = Baseline(
    options=GsHiderOptions,
    capabilities=Capabilities(keys=False, standard=False),
    open=_open,
    training=GsHiderTraining,
)
