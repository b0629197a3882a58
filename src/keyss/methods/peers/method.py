"""The common part of the peers: one secret, one joint training, one file that is handed over."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from keyss.channels import Content
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.base import Capabilities, CommandLineOption, Context, Plan, Source, Stego, check_above_zero
from keyss.methods.joint import JointTraining, train_jointly
from keyss.methods.joint_options import JointOptions
from keyss.methods.peers.payload import DAMAGED, HandedSecret, HandedTensors, Show
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

    @abstractmethod
    def publish(self) -> tuple[Gaussians, HandedTensors]:
        """The published model, on the CPU, and the tensors to hand over, after the training."""

    @property
    def frame(self) -> Similarity:
        """From the secret's own frame into the cover's."""
        return self.scenes[1].frame

    def visible(self) -> Tensor:
        """[N] which Gaussians have an opacity above the limit of pruning; all if none has."""
        visible = self.opacity_for_pruning() >= self.options.fit.prune_opacity
        return visible if bool(visible.any()) else torch.ones_like(visible)


@dataclass(frozen=True)
class Peer:
    """A `Method` with a joint training, one secret, and one file that is handed over for it."""

    options: type[PeerOptions]
    summary: str
    capabilities: Capabilities
    open: Callable[[HandedTensors], Show]  # raises InputError and ValueError for damage
    training: type[PeerTraining] | None = None  # None: `hide` is another
    pixel_weights: int = 0  # see `Plan`
    most_secrets: int = 1

    @property
    def name(self) -> str:
        return self.options.method

    def prepare(self, sources: Sequence[Source], options: PeerOptions) -> PeerOptions:
        """Accepts all scenes."""
        return options

    def plan(self, sources: Sequence[Source], options: PeerOptions) -> Plan:
        """As many Gaussians as a plain model show both scenes."""
        return options.joint_plan(1, pixel_weights=self.pixel_weights)

    def hide(self, cover: Source, secrets: Sequence[Source], options: PeerOptions, context: Context) -> Stego:
        """Train both scenes together. Raises Interrupted, and InputError for another run's checkpoint."""
        training = self.training
        assert training is not None
        run = train_jointly(lambda placed: training(placed, options, context.device), cover, secrets, context)
        return self.stego(*run.publish(), run.iterations)

    def stego(self, published: Gaussians, handed: HandedTensors, iterations: int = 0) -> Stego:
        """The result of hiding, opened from the payload that is handed over."""
        payload = handed.payload(self.name)
        return Stego(published, (self.unpack(payload),), iterations, handed=(payload,))

    def unpack(self, content: Content) -> HandedSecret:
        """The secret of a handed-over file. Raises InputError for damage."""
        handed = HandedTensors.of(content)
        with damage_refused(DAMAGED):
            return HandedSecret(handed, self.open(handed))
