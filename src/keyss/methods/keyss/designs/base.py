"""The base of KeySS's designs: settings, and a training whose result is published."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.methods.combined import PlacedScene
from keyss.methods.joint import JointTraining
from keyss.methods.keyss.rows import RowSecret
from keyss.methods.keyss.secret import HiddenSecret

if TYPE_CHECKING:
    from keyss.methods.keyss.options import KeyssOptions


class DesignTraining(JointTraining):
    """A joint training whose result is published.

    `start` has the Gaussians that it starts with, `prepare` its decoders, `draw` how a key conditions what is
    rendered, and `density_control` what clones, splits and prunes.
    """

    def __init__(
        self,
        scenes: Sequence[PlacedScene],
        embeddings: Sequence[Tensor],  # [64] of each secret's key
        options: KeyssOptions,
        device: torch.device,
    ) -> None:
        self.design: Any = options.settings
        self.embeddings = [embedding.to(device) for embedding in embeddings]
        super().__init__(scenes, options, device, common_poses=self.design.common_poses, **self.design.joint)

    @abstractmethod
    def publish(self, entropy: bytes) -> tuple[Gaussians, Sequence[HiddenSecret | RowSecret]]:
        """The published model before its low bits, and what reveals each secret, on the CPU.

        `entropy`: 32 secret bytes from which all randomness is derived.
        """


@dataclass(frozen=True, kw_only=True)
class Design(ABC):
    """Settings of a design; an option of the same name overrides one."""

    training: ClassVar[type[DesignTraining]]

    # Share of the steps that render all scenes from one pose, against a photo or the plain model's render. In
    # the others each scene has a pose and a photo of its own.
    common_poses: float = 0.0
    ssim_weight: float | None = None  # of the loss, also for plain models; None: that of `fit`

    @property
    def joint(self) -> dict[str, Any]:
        """Further arguments of `JointTraining`."""
        return {}

    @abstractmethod
    def payload_bytes(self, sh_degree: int, secrets: int) -> int:
        """Bytes of one of so many secrets at most. Raises UsageError where a model cannot have so many."""

    def weights(self, sh_degree: int, secrets: int) -> float:
        """Weights that a step multiplies each Gaussian's numbers with; see `Plan`."""
        return 0.0
