"""What a design of KeySS is: settings, a training, and what reveals a secret."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from keyss.channels import Payload
from keyss.core.gaussians import Gaussians
from keyss.methods.joint import JointTraining
from keyss.methods.joint_options import JointOptions
from keyss.methods.opened import Opened
from keyss.methods.poses import PlacedScene

DesignName = Literal["carriers", "mlp", "published", "released"]


class Secret(Opened, Protocol):
    """What reveals a secret, and can be packed."""

    def payload(self) -> Payload:
        """What a channel carries; the same secret gives the same bytes."""


class DesignTraining(JointTraining):
    """A joint training whose result is published.

    `start` has the Gaussians that it starts with, `prepare` its decoders, `draw` how a key conditions what is
    rendered, and `density_control` what clones, splits and prunes.
    """

    @abstractmethod
    def publish(self, entropy: bytes) -> tuple[Gaussians, Sequence[Secret]]:
        """The published model before its low bits, and what reveals each secret, on the CPU.

        `entropy`: 32 bytes that nobody else can know, from which all that is random is derived.
        """


@dataclass(frozen=True, kw_only=True)
class Design(ABC):
    """Settings of a design; an option of the same name overrides one."""

    # Share of the steps that render all scenes from one pose, against a photo or the plain model's render. In
    # the others each scene has a pose and a photo of its own.
    common_poses: float = 0.0
    ssim_weight: float | None = None  # of the loss, also for plain models; None: that of `fit`

    @abstractmethod
    def training(
        self,
        scenes: Sequence[PlacedScene],
        embeddings: Sequence[Tensor],  # [64] of each secret's key
        options: JointOptions,
        device: torch.device,
    ) -> DesignTraining:
        """The training, at its start."""

    @abstractmethod
    def payload_bytes(self, sh_degree: int, secrets: int) -> int:
        """Bytes of one of so many secrets at most. Raises UsageError where a model cannot have so many."""

    def weights(self, sh_degree: int, secrets: int) -> float:
        """Weights that a step multiplies each Gaussian's numbers with; see `Plan`."""
        return 0.0


def design(name: DesignName) -> Any:
    """The `Design` of that name."""
    return import_module(f"keyss.methods.keyss.designs.{name}").DESIGN
