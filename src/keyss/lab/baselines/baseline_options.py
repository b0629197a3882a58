"""Options of the baselines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

from keyss.fitting.config import FitConfig
from keyss.methods.keyss.keyss_options import DecoderShape, Design, JointOptions, Scenes
from keyss.methods.method import CommandLineOption, Training, check_above_zero


@dataclass(frozen=True, kw_only=True)
class BaselineOptions(JointOptions):
    """Options of all baselines: joint training has the steps and Gaussians of plain models.

    It combines poses, points and densification like KeySS's. Each baseline has its own class, which
    identifies it.
    """

    points: ClassVar[Scenes] = "both"  # scenes whose sparse points start the model
    step_cost: ClassVar[float] = 1.0  # measured at 2,000 Gaussians and 100 x 75 pixels

    common_poses: Annotated[
        float,
        CommandLineOption(
            "Share of steps that render both scenes from one pose, 0 to 1, as in KeySS.", metavar="SHARE"
        ),
    ] = Design.common_poses
    network_rate: float = 5e-4  # AdamW; follows the length of the run like KeySS's

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above_zero(self, "network_rate")
        _ = self.configuration  # raises for values out of range

    @property
    def configuration(self) -> Design:
        """The configuration of the joint training, without a decoder of Gaussians and keys."""
        return Design(
            name=self.method,
            decoder=DecoderShape(),
            ssim_weight=None,
            beta_incorrect=0.0,
            points=self.points,
            common_poses=self.common_poses,
            decoder_rate=self.network_rate,
            weight_decay=0.0,
        )


@dataclass(frozen=True, kw_only=True)
class BoundOptions(BaselineOptions):
    """Options of the plain models."""

    method: ClassVar[str] = "3dgs"

    # Share of the Gaussians of other methods. One set of Gaussians that serves two scenes has half for each.
    gaussians: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above_zero(self, "gaussians")

    @classmethod
    def variants(cls) -> dict[str, Self]:
        """The bound of a model that both scenes share."""
        return {"half": cls(gaussians=0.5)}

    def fits(self, scenes: int) -> list[FitConfig]:
        """The fits of the plain models."""
        count = max(16, int(self.gaussians * self.fit.max_gaussians))
        return [replace(self.fit, max_gaussians=count)] * scenes

    def training(self, scenes: int) -> tuple[Training, ...]:
        """No training beside that of plain models."""
        return (Training(),) * scenes


@dataclass(frozen=True, kw_only=True)
class DecoderOptions(BaselineOptions):
    """The Gaussians show the cover only, so they start from its points."""

    method: ClassVar[str] = "3dgs-decoder"
    points: ClassVar[Scenes] = "cover"
    step_cost: ClassVar[float] = 16.0


@dataclass(frozen=True, kw_only=True)
class GsHiderOptions(BaselineOptions):
    """See `BaselineOptions`."""

    method: ClassVar[str] = "gs-hider"
    step_cost: ClassVar[float] = 30.0


@dataclass(frozen=True, kw_only=True)
class WaterGsOptions(BaselineOptions):
    """See `BaselineOptions`."""

    method: ClassVar[str] = "watergs"
    step_cost: ClassVar[float] = 2.0


@dataclass(frozen=True, kw_only=True)
class ShOptions(BaselineOptions):
    """See `BaselineOptions`."""

    method: ClassVar[str] = "3dgs-sh"
    step_cost: ClassVar[float] = 2.0
