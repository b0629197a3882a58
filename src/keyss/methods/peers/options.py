"""The options of the peers: the same for all. Each has its own class, which tells methods apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from keyss.methods.base import CommandLineOption, check_above_zero
from keyss.methods.joint_options import JointOptions


@dataclass(frozen=True, kw_only=True)
class PeerOptions(JointOptions):
    """The joint training is as long and has as many Gaussians as plain models."""

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
