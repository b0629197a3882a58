"""Designs with a network: a decoder for each secret adds residuals to the cover's Gaussians.

KeySS, sections 3.2 to 3.4. Start: the sparse points of all scenes. Density: gradients of all scenes together.
Conditioning: a bias of the network's first layer, and a loss of wrong keys; or a gate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch
from gsplat.strategy.ops import remove
from torch import Tensor

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import Optimizers, Parameters, to_gaussians
from keyss.keys.derivation import random_embeddings, stream
from keyss.methods.base import check_above_zero
from keyss.methods.joint import Picture, Pose
from keyss.methods.keyss.decoder import APART, Decoder, DecoderShape
from keyss.methods.keyss.designs.base import Design, DesignTraining
from keyss.methods.keyss.secret import ANCHORS, HiddenSecret, choose_anchors

_VISIBLE = 0.05  # opacity from which a Gaussian counts for a scene
_SLACK = 0.02  # scene extents by which a decoder may move a Gaussian


class NetworkTraining(DesignTraining):
    """Gaussians that show the cover, and for each secret a decoder that makes its Gaussians of them."""

    warm_up = 100
    design: NetworkDesign

    def start(self) -> Gaussians:
        # Without a gate, a wrong key would show the secret that its decoder starts with.
        design, points = self.design, self.options.points
        chosen = (design.conditioning, design.inputs, points) == ("gate", "standardised", "both")
        self.apart = APART if chosen and "op" in design.mask else 0.0
        return super().start()

    def prepare(self, start: Gaussians) -> None:
        # A network for each secret: whoever opens one secret has no network trained on another.
        shape = self.design.shape(self.options.fit.sh_degree)
        self.decoders = [Decoder(shape) for _ in self.embeddings]
        for scene, (decoder, embedding) in enumerate(zip(self.decoders, self.embeddings, strict=True), 1):
            decoder.prepare(start, embedding)
            if self.apart:
                decoder.network.separate(float(start.opacity_logits.max()), scene)
        self.networks.extend(self.decoders)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        cover = to_gaussians(self.parameters)
        return [self._draw(cover, scene, camera, sh_degree) for scene in scenes]

    def _draw(self, cover: Gaussians, scene: int, camera: Camera, sh_degree: int) -> Picture:
        if scene == 0:
            return self.render(cover, scene, camera, sh_degree)
        seen = possibly_seen(cover, camera, _SLACK * self.extent)
        secret = self.decoders[scene - 1](cover[seen], self.embeddings[scene - 1], cover)
        return self.render(secret, scene, camera, sh_degree, seen)

    def extras(self) -> Sequence[Tensor | None]:
        """Embeddings [64] of wrong keys; a gate needs none."""
        if self.design.conditioning == "gate":
            return super().extras()
        return [random_embeddings(1, self.generator)[0].to(self.device) for _ in range(self.views_per_step)]

    def loss_at(self, poses: Sequence[Pose], extra: Tensor | None) -> tuple[Tensor, list[Rendered]]:
        total, renders = super().loss_at(poses, extra)
        if extra is None:
            return total, renders
        # The cover is right already: only the decoders learn from wrong keys, in turns.
        fit, cover, camera = self.options.fit, self.gaussians(), self.poses.camera(*poses[0])
        decoder = self.decoders[self.iteration % len(self.decoders)]
        part = cover[possibly_seen(cover, camera, _SLACK * self.extent)]
        picture = self.render(decoder(part, extra, cover), 0, camera, fit.sh_degree_at(self.iteration))
        loss = photometric_loss(picture.image, self.poses.target(0, *poses[0]), fit.ssim_weight)
        return total + self.design.incorrect_weight * len(self.decoders) * loss, renders

    def density_control(self) -> CappedStrategy:
        if self.design.at_cap == "even" and len(self.growing) == len(self.scenes):
            return EvenGrowth(self.options.fit, self.opacities, len(self.scenes))
        return CappedStrategy(
            self.options.fit, self.opacity_for_pruning, freeze=self.design.at_cap == "freeze"
        )

    @torch.no_grad()
    def opacity_for_pruning(self) -> Tensor:
        return super().opacity_for_pruning() if self.design.prune_by == "cover" else self.opacities().amax(1)

    @torch.no_grad()
    def opacities(self) -> Tensor:
        """[N, S] in every scene."""
        cover = self.gaussians()
        decoded = [each(cover, key) for each, key in zip(self.decoders, self.embeddings, strict=True)]
        return torch.stack([model.opacities for model in (cover, *decoded)], dim=1)

    def gaussians(self) -> Gaussians:
        """The model as it would be published."""
        return to_gaussians(self.parameters).detach()

    def publish(self, entropy: bytes) -> tuple[Gaussians, list[HiddenSecret]]:
        # In a random order: in training, the points of each scene lie together.
        stego = self.gaussians().to("cpu")
        numbers = np.frombuffer(stream(entropy, "order", 8 * len(stego)), "<u8")
        stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
        anchors = choose_anchors(stego, torch.Generator().manual_seed(self.options.fit.known_seed))
        secrets = []
        for decoder, placed in zip(self.decoders, self.scenes[1:], strict=True):
            secret = HiddenSecret(decoder.to("cpu").requires_grad_(False), placed.frame, anchors)
            visible = secret.decode(stego, secret.embedding).opacities >= DRAWN_OPACITY
            secrets.append(replace(secret, count=int(visible.sum())))
        return stego, secrets


class EvenGrowth(CappedStrategy):
    """Density control that gives free places to the scenes that have fewer Gaussians than their share.

    If the largest gradients decided, a scene with more detail would take nearly all places. At the cap,
    Gaussians that are invisible in every scene are removed first.
    """

    def __init__(self, fit: FitConfig, opacities: Callable[[], Tensor], scenes: int) -> None:
        super().__init__(fit, lambda: opacities().amax(1))
        self.opacities, self.scenes = opacities, scenes

    def combined(self, renders: Sequence[Rendered], count: int) -> dict[str, Any]:
        return self.by_scene(renders, count, self.scenes, dim=1)

    @torch.no_grad()
    def _grow_gs(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int
    ) -> tuple[int, int]:
        visible = self.opacities() > _VISIBLE  # [N, S]
        shown = visible.any(1)
        if len(visible) >= self.max_gaussians and shown.any():
            remove(params=params, optimizers=optimizers, state=state, mask=~shown)
        gradients = state["grad2d"] / state["count"].clamp_min(1)  # [N, S]
        missing = (self.max_gaussians / self.scenes - visible.sum(0)).clamp_min(0)
        room = max(0, self.max_gaussians - len(gradients))
        shares = (room * missing / missing.sum().clamp_min(1e-9)).long().tolist()
        chosen = torch.zeros(len(gradients), dtype=torch.bool, device=gradients.device)
        for scene, share in enumerate(shares):
            own = gradients[:, scene].masked_fill(chosen, 0)
            best = own.topk(min(share, len(own))).indices
            chosen[best[own[best] > self.grow_grad2d]] = True
        state["grad2d"], state["count"] = gradients.amax(1) * chosen, torch.ones_like(gradients[:, 0])
        grown = super()._grow_gs(params, optimizers, state, step)
        state["grad2d"] = state["grad2d"][:, None].expand(-1, self.scenes).clone()
        state["count"] = state["count"][:, None].expand(-1, self.scenes).clone()
        return grown


@torch.no_grad()
def possibly_seen(gaussians: Gaussians, camera: Camera, slack: float) -> Tensor:
    """Indices of the Gaussians that may touch the view once decoded: only they are worth decoding.

    A Gaussian is left out when a ball of 3 standard deviations around it, widened by `slack` (world units, by
    what the decoder may move it), lies outside the frustum, widened by a tenth.
    """
    viewmat, centre = camera.viewmat.to(gaussians.device), camera.K[:2, 2]
    opposite = centre.new_tensor([camera.width, camera.height]) - centre
    slopes = (torch.maximum(centre, opposite) / camera.K.diagonal()[:2]).to(viewmat)  # of the frustum's sides
    means = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    radius = 3 * gaussians.scales.amax(1, keepdim=True) + slack
    depth = means[:, 2:] + radius
    seen = (depth > 0.01) & (means[:, :2].abs() - radius < 1.1 * slopes * depth)
    return seen.all(1).nonzero()[:, 0]


@dataclass(frozen=True, kw_only=True)
class NetworkDesign(DecoderShape, Design):
    """The decoders' shape, for any `sh_degree`, and more. Raises UsageError for settings that do not work."""

    training = NetworkTraining

    decoder_rate: float = 1e-3  # of AdamW, decays to 5 % of it
    weight_decay: float = 1e-4  # of the decoders
    incorrect_weight: float = 0.05  # beta_incorrect: wrong keys against the cover; a gate needs none
    # Who gets free places: scenes with fewer Gaussians than their share, or the largest gradients of all
    # scenes, which wait at the cap until others are pruned; "freeze": none are.
    at_cap: Literal["even", "wait", "freeze"] = "even"
    prune_by: Literal["all", "cover"] = "all"  # scenes in which an opaque Gaussian is spared

    def __post_init__(self) -> None:
        check_above_zero(self, "decoder_rate")

    @property
    def joint(self) -> dict[str, Any]:
        return {"network_rate": self.decoder_rate, "weight_decay": self.weight_decay}

    def shape(self, sh_degree: int) -> DecoderShape:
        """Kind and sizes of the decoders."""
        own = {field.name: getattr(self, field.name) for field in fields(DecoderShape)}
        return DecoderShape(**own | {"sh_degree": sh_degree})

    def payload_bytes(self, sh_degree: int, secrets: int) -> int:
        decoder = Decoder(self.shape(sh_degree))
        return len(HiddenSecret(decoder, Similarity(), torch.rand(ANCHORS, 3)).payload().data)

    def weights(self, sh_degree: int, secrets: int) -> float:
        return (secrets + (self.conditioning == "bias")) * self.shape(sh_degree).network_weights


# The paper's architecture with inputs, rates, poses and conditioning that work at small scale.
MLP = NetworkDesign(common_poses=0.1)

# The paper's text (KeySS, sections 3.2 to 3.4 and appendix).
PUBLISHED = NetworkDesign(
    mask=("op", "ro", "sc", "xyz"),
    conditioning="bias",
    hidden=(64, 128),
    branch=64,
    frequencies=0,
    inputs="normalised",
    decoder_rate=5e-5,
    common_poses=1.0,
    incorrect_weight=0.01,
    ssim_weight=0.5,
    at_cap="wait",
)

# The authors' program, where it differs from the paper's text.
RELEASED = replace(PUBLISHED, residuals="one-sided", ssim_weight=None, at_cap="freeze", prune_by="cover")
