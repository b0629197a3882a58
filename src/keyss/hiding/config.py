"""What hiding can be told, with the paper's names where it has them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from keyss.core.errors import UsageError
from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.fitting.config import FitConfig
from keyss.hiding.mask import Mask


@dataclass(frozen=True, kw_only=True)
class HideConfig:
    """The joint training of the published model and the decoder (KeySS, section 3.4)."""

    fit: FitConfig = field(default_factory=FitConfig)  # schedule, cap and rates, also of the plain models

    mask: Mask = ("op", "ro", "sc", "xyz")  # theta: the attributes that the decoder updates
    start: Literal["warm", "points"] = (
        "warm"  # from the plain models' Gaussians, or from sparse points (paper)
    )
    hidden: int = 128  # width of the decoder's common branch
    branch: int = 32  # width of its branch per attribute
    frequencies: int = 6  # octaves of its positional encoding

    cover_weight: float = 0.5  # beta_cover
    secret_weight: float = 0.5  # beta_secret, of each secret
    incorrect_weight: float = 0.05  # beta_incorrect: wrong keys against the cover
    incorrect_every: int = 4  # steps between two wrong keys; the weight is multiplied by it

    secret_share: float = 2 / 3  # warm start: Gaussians of each secret for one of the cover
    warm_rate: float = 0.5  # warm start: factor on the rates of the Gaussians, which are nearly right
    distil_steps: int = 600  # warm start: steps that teach the decoder who belongs to which scene
    distil_rate: float = 3e-3
    decoder_rate: float = 1e-3  # of AdamW, decays to 5 % of it
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        if self.start == "warm" and "op" not in self.mask:
            raise UsageError(
                f"mask {','.join(self.mask)}: a warm start hides the secret's Gaussians by their opacity and "
                "needs op in the mask; start from points instead (--start points)"
            )

    def with_fit(self, **changes: object) -> HideConfig:
        """The same with changed fields of `fit`."""
        return replace(self, fit=replace(self.fit, **changes))  # type: ignore[arg-type]


PRESETS: dict[str, HideConfig] = {
    "quick": HideConfig(fit=FIT_PRESETS["quick"], distil_steps=400),
    "default": HideConfig(),
}
