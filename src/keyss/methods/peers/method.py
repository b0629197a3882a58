"""The common part of the peers: one secret, one joint training, one file that is handed over."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from keyss.channels import Content
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.base import Capabilities, CommandLineOption, Context, Source, Stego, check_above_zero
from keyss.methods.joint import JointTraining, train_jointly
from keyss.methods.joint_options import JointOptions
from keyss.methods.peers.payload import DAMAGED, HandedSecret, HandedTensors
from keyss.methods.plan import Plan
from keyss.methods.poses import PlacedScene
from keyss.methods.tensors import damage_refused


@dataclass(frozen=True, kw_only=True)
class PeerOptions(JointOptions):
    """Options of all peers: the joint training is as long and has as many Gaussians as plain models.

    Each peer has its own class, by which its options are recognised.
    """

    common_poses: Annotated[
        float,
        CommandLineOption(
            "Share of steps that render both scenes from one pose, 0 to 1; the papers': 1.",
            metavar="SHARE",
        ),
    ] = 1.0
    network_rate: float = 1e-3  # of Adam, decays to 5 % of it

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above_zero(self, "network_rate")
        self.check_poses(self.common_poses)


class PeerTraining(JointTraining):
    """The joint training with the options of peers."""

    options: PeerOptions

    def __init__(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> None:
        poses, rate = options.common_poses, options.network_rate
        super().__init__(scenes, options, device, common_poses=poses, network_rate=rate)

    @property
    def frame(self) -> Similarity:
        """From the secret's own frame into the cover's."""
        return self.scenes[1].frame

    def kept(self) -> dict[str, Tensor]:
        """The parameters on the CPU, without Gaussians whose opacity is below the limit of pruning."""
        visible = self.opacity_for_pruning() >= self.options.fit.prune_opacity
        visible = visible if bool(visible.any()) else torch.ones_like(visible)
        return {name: value.detach()[visible].cpu() for name, value in self.parameters.items()}


def gaussians_of(tensors: Mapping[str, Tensor], opacities: Tensor, sh: Tensor) -> Gaussians:
    """Gaussians with the means, quaternions and scales of the parameters, and these logits and harmonics."""
    return Gaussians(tensors["means"], tensors["quats"], tensors["scales"], opacities, sh)


class Peer(ABC):
    """A `Method` with one secret, and one file that is handed over for it."""

    name: str
    summary: str
    capabilities: Capabilities
    most_secrets = 1
    options: type[PeerOptions]

    @abstractmethod
    def open(self, handed: HandedTensors) -> HandedSecret:
        """The secret of a handed-over file. Raises InputError and ValueError for damage."""

    def prepare(self, sources: Sequence[Source], options: PeerOptions) -> PeerOptions:
        """Accepts all scenes."""
        return options

    def unpack(self, content: Content) -> HandedSecret:
        """See `open`."""
        handed = HandedTensors.of(content)
        with damage_refused(DAMAGED):
            return self.open(handed)


class JointPeer(Peer):
    """A peer with a joint training."""

    training: ClassVar[type[PeerTraining]]
    pixel_weights = 0  # see `Plan`

    @abstractmethod
    def publish(self, run: Any) -> tuple[Gaussians, HandedTensors]:
        """The published model, on the CPU, and the tensors to hand over, of a finished training."""

    def plan(self, sources: Sequence[Source], options: PeerOptions) -> Plan:
        """As many Gaussians as a plain model show both scenes."""
        return options.joint_plan(1, pixel_weights=self.pixel_weights)

    def hide(self, cover: Source, secrets: Sequence[Source], options: PeerOptions, context: Context) -> Stego:
        """Train both scenes together. Raises Interrupted, and InputError for another run's checkpoint."""
        run = train_jointly(
            lambda placed: self.training(placed, options, context.device), cover, secrets, context
        )
        stego, handed = self.publish(run)
        payload = handed.payload(self.name)
        return Stego(stego, (self.unpack(payload),), run.iterations, handed=(payload,))
