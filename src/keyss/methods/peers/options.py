"""What the peers can be told: the same for all; each has a class of its own, by which it is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeVar

from keyss.core.errors import UsageError
from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.methods.base import CommandLineOption, MethodOptions, Training, check_above_zero


@dataclass(frozen=True, kw_only=True)
class PeerOptions(MethodOptions):
    """The joint training from sparse points, as long and with as many Gaussians as plain models (`fit`)."""

    # Whose sparse points it starts from: KeySS's combined ones, where one geometry shows both scenes.
    points: Literal["both", "cover"] = "both"
    cover_weight: float = 0.5
    secret_weight: float = 0.5
    # Share of the steps at which both scenes are drawn from one pose, as the papers do, and compared with a
    # photo or the plain model's render; at the others each from a pose of its own, compared with its photo.
    common_poses: Annotated[
        float,
        CommandLineOption(
            "Share of steps at which both scenes are drawn from one pose, 0 to 1; the papers': 1.",
            metavar="SHARE",
        ),
    ] = 1.0
    network_rate: float = 1e-3  # of Adam, decays to 5 % of it

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish != "ply":
            raise UsageError(
                f'`publish="{self.publish}"` is for methods that look for room in such a file; this one is '
                'compared as it was published: leave it out, or take `method="learned"` or "carry"'
            )
        check_above_zero(self, "cover_weight", "secret_weight", "network_rate")
        if not 0 <= self.common_poses <= 1:
            raise UsageError(f"`common_poses`: expected 0 to 1, got {self.common_poses}")

    def training(self, scenes: int) -> tuple[Training, ...]:
        """From points: both scenes are drawn at every step."""
        return (Training(self.fit.iterations, goes_on=False),) * scenes


OptionsT = TypeVar("OptionsT", bound=PeerOptions)


def presets_of(kind: type[OptionsT]) -> dict[str, OptionsT]:
    """As those of other methods."""
    return {
        "best": kind(),
        "quick": kind(fit=FIT_PRESETS["quick"]),
        "paper": kind(fit=replace(FIT_PRESETS["paper"], ssim_weight=0.5)),
    }
