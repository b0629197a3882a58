"""How large a hiding of given models is, and how long it trains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.methods.learned.config import HideConfig


def room_for_models(config: HideConfig, models: Sequence[Gaussians]) -> HideConfig:
    """`config` with a cap that holds all `models`, the SH degree they need, and a short, gentle schedule.

    Degree 1 is the least: spherical harmonics above the constant ones are where most low bits are. Where
    nothing has to be left out the start is right already, and large steps would only do harm.
    """
    return replace(
        config,
        warm_rate=0.1,
        fit=replace(
            config.fit,
            iterations=min(config.fit.iterations, 400),
            max_gaussians=max(16, sum(len(model) for model in models)),
            sh_degree=max(1, *(model.sh_degree for model in models)),
        ),
    )
