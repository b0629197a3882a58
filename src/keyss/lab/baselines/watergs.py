"""WaterGS, also called Splats in Splats (Guo et al., 2024): harmonics in harmonics, opacities autoencoded.

Both scenes share positions, rotations and scales. The secret's harmonics lie in the low bits of the cover's:
the lower their degree, the more important they are, and the more bits they get. An encoder changes the
published opacities, so that a decoder in the companion file finds the secret's. Bits and networks follow
after the training, which is not end to end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.loop import own_randomness
from keyss.fitting.parameters import to_gaussians
from keyss.fitting.schedule import boost_of
from keyss.lab.baselines.baseline import Baseline, BaselineTraining, CompanionTensors, Show
from keyss.lab.baselines.baseline_options import WaterGsOptions
from keyss.methods.keyss.training import Picture
from keyss.methods.method import Capabilities

BITS = (14, 12, 10, 8)  # of the secret's coefficients, by degree, in the cover's 23-bit mantissas
WIDTH = 32  # of both networks
STEPS, RATE = 1500, 3e-3  # of the autoencoder
FIDELITY = 10.0  # weight of the cover's opacities
_NAMES = ("sh", "secret_sh"), ("opacities", "secret_opacities")  # parameters of the cover and the secret


class WaterGsTraining(BaselineTraining):
    """The training of two sets of harmonics and opacities; geometry is shared."""

    def prepare(self, start: Gaussians) -> None:
        """Both sets start equal: every point has the colour of its own scene."""
        (rates,) = self.optimizers["sh"].param_groups
        self.add(_NAMES[0][1], start.sh.clone(), rates["lr"], rates["lr_scale"])
        # As the schedule boosts opacities: by the fourth root.
        self.add(
            _NAMES[1][1], start.opacity_logits.clone(), self.fit.opacities_rate * boost_of(self.fit) ** -0.75
        )

    def model(self, scene: int) -> Gaussians:
        """The Gaussians of a scene, attached to the graph."""
        sh, opacities = (self.parameters[names[scene]] for names in _NAMES)
        return replace(to_gaussians(self.parameters), sh=sh, opacity_logits=opacities)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        return [self.render(self.model(scene), scene, camera, sh_degree) for scene in scenes]

    def opacity_for_pruning(self) -> Tensor:
        return torch.maximum(*(self.parameters[name].detach().sigmoid() for name in _NAMES[1]))

    def result(self) -> tuple[Gaussians, CompanionTensors]:
        visible = self.visible()
        cover, secret = (self.model(scene).detach()[visible].to("cpu") for scene in (0, 1))
        with own_randomness(self.fit.known_seed):
            logits, network = hide_opacities(cover, secret.opacity_logits)
        sh, limits = hide_harmonics(cover.sh, secret.sh)
        stego = replace(cover, sh=sh, opacity_logits=logits)
        tensors = {"limits": limits, **network.state_dict()}
        return stego, CompanionTensors(tensors, self.scenes[1].frame)


def bits_of(coefficients: int) -> Tensor:
    """[K, 1] bits of each of K coefficients."""
    degrees = [degree for degree in range(len(BITS)) for _ in range(2 * degree + 1)]
    return torch.tensor([BITS[degree] for degree in degrees[:coefficients]])[:, None]


def hide_harmonics(cover: Tensor, secret: Tensor) -> tuple[Tensor, Tensor]:
    """`cover` [N, K, 3] with `secret`, quantised, in the low bits; the secret's largest numbers [K, 1]."""
    limits = secret.abs().amax((0, 2))[:, None].clamp_min(1e-6)
    steps = (1 << bits_of(cover.shape[1])) - 1
    codes = ((secret / limits + 1) / 2 * steps).round().int()
    words = cover.contiguous().view(torch.int32)
    return ((words & ~steps.int()) | codes).view(torch.float32), limits


def read_harmonics(stego: Tensor, limits: Tensor) -> Tensor:
    """Invert `hide_harmonics`, up to the quantisation."""
    steps = (1 << bits_of(stego.shape[1])) - 1
    codes = stego.contiguous().view(torch.int32) & steps.int()
    return (2 * codes / steps - 1) * limits


def network_of(inputs: int) -> nn.Sequential:
    """A network from numbers of a Gaussian to one number."""
    return nn.Sequential(
        nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1)
    )


def known_of(stego: Gaussians, logits: Tensor) -> Tensor:
    """[N, 11] the decoder's inputs: the published opacity, and what surrounds it in the file."""
    return torch.cat([logits[:, None] / 8, stego.log_scales / 8, stego.quats, stego.sh[:, 0]], dim=1)


def hide_opacities(cover: Gaussians, secret: Tensor) -> tuple[Tensor, nn.Sequential]:
    """Opacity logits [N] to publish, near the cover's, and the decoder that maps them to the secret's [N]."""
    encoder, decoder = network_of(12), network_of(11)
    optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], RATE)
    known = torch.cat([known_of(cover, cover.opacity_logits), secret[:, None] / 8], dim=1)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * 0.01 ** (step / STEPS)
        published = cover.opacity_logits + encoder(known)[:, 0]
        decoded = decoder(known_of(cover, published))[:, 0]
        loss = (decoded.sigmoid() - secret.sigmoid()).square().mean()
        loss = loss + FIDELITY * (published.sigmoid() - cover.opacities).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return published.detach(), decoder.requires_grad_(False)


def _open(companion: CompanionTensors) -> Show:
    network = network_of(11).requires_grad_(False)
    limits, *weights = companion.take(["limits", *network.state_dict()])
    network.load_state_dict(dict(zip(network.state_dict(), weights, strict=True)))

    def show(stego: Gaussians) -> Gaussians:
        logits = network(known_of(stego, stego.opacity_logits))[:, 0]
        return replace(stego, sh=read_harmonics(stego.sh, limits), opacity_logits=logits)

    return show


METHOD = Baseline(
    options=WaterGsOptions, capabilities=Capabilities(keys=False), open=_open, training=WaterGsTraining
)
