"""The options of a joint training, whichever method runs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from keyss.core.errors import UsageError
from keyss.methods.base import MethodOptions, Plan, Training, check_above_zero

Scenes = Literal["both", "cover", "secret"]  # "both": all scenes, also with several secrets


def chosen_scenes(which: Scenes, count: int) -> list[int]:
    """Indices of the scenes that `which` stands for, of the cover (0) and the secrets."""
    return {"both": list(range(count)), "cover": [0], "secret": list(range(1, count))}[which]


@dataclass(frozen=True, kw_only=True)
class JointOptions(MethodOptions):
    """A training of all scenes together from sparse points; `fit` has its length, size and rates."""

    points: Scenes = "both"  # scenes whose sparse points start the model (combined SfM initialisation)
    poses: Scenes = "both"  # scenes whose training poses are used (combined camera poses)
    densification: Scenes = "both"  # scenes whose gradients ask for growth (combined densification)
    cover_weight: float = 0.5
    secret_weight: float = 0.5  # of each secret

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish != "ply":
            raise UsageError(
                f'`publish="{self.publish}"`: this method needs the published model bit for bit: leave it '
                'out, or use `method="carry"`'
            )
        check_above_zero(self, "cover_weight", "secret_weight")

    def training(self, scenes: int) -> tuple[Training, ...]:
        """Every step renders all scenes."""
        return (Training(self.fit.iterations, continues=False),) * scenes

    def check_poses(self, common_poses: float) -> None:
        """Raise UsageError for a share of common poses that does not go with `poses`."""
        if not 0 <= common_poses <= 1:
            raise UsageError(f"`common_poses`: expected 0 to 1, got {common_poses}")
        if self.poses != "both" and common_poses < 1:
            raise UsageError(
                "poses of some scenes only: needs common_poses = 1, because all scenes are rendered from them"
            )

    def joint_plan(self, secrets: int, *, gaussian_weights: float = 0.0, pixel_weights: float = 0.0) -> Plan:
        """As many Gaussians as a plain model has show all scenes. `*_weights`: see `Plan`."""
        fit = self.fit
        return Plan(
            gaussians=fit.max_gaussians,
            sh_degree=fit.sh_degree,
            asked=secrets * fit.max_gaussians,
            capacity=fit.max_gaussians,
            steps=fit.iterations,
            drawn=(fit.max_gaussians,) * (1 + secrets),
            gaussian_weights=gaussian_weights,
            pixel_weights=pixel_weights,
        )
