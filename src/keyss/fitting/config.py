"""Settings of a training run, with defaults for most scenes."""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass, replace

from keyss.core.errors import UsageError

MAX_SEED = 2**48 - 1  # every reader of JSON represents it exactly


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Plain 3DGS (Kerbl et al. 2023, section 5 and appendix), with a schedule in fractions of the run.

    The original has absolute step numbers. Fractions give 1,000 iterations the same phases as 30,000.
    """

    iterations: int = 1000
    max_gaussians: int = 30_000  # cap
    sh_degree: int = 3
    ssim_weight: float = 0.2  # lambda of the photometric loss
    # None: each run samples its own from the system.
    seed: int | None = None

    means_rate: float = 1.6e-4  # times the scene's extent, decays to 1 % of it
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 5e-2
    sh0_rate: float = 2.5e-3
    shN_rate: float = 1.25e-4

    # Factor on these rates at the start of a run, see `fitting.schedule`; None: depends on `iterations`.
    boost: float | None = None

    # Last share of the run, in which all rates decay to a tenth: at constant rates, Gaussians jitter around
    # their optimum. It helps only models that do not grow.
    settle: float = 0.0

    # First share of a growing run, in which large photos are shrunk, see `schedule.shrinking`; 0: never.
    coarse: float = 0.5

    grow_start: float = 0.1  # densification starts here, or at 500 iterations if that is earlier
    grow_stop: float = 0.6
    grow_every: int | None = None  # steps; None: a thirtieth of the run, at most 100
    # Mean screen-space gradient norm above which a Gaussian is cloned or split; a boost makes it larger.
    grow_gradient: float = 2e-4
    prune_opacity: float = 5e-3

    evaluate_every: int = 500
    checkpoint_seconds: float = 180.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("iterations", 1, 10**7),
            ("max_gaussians", 16, 10**8),
            ("sh_degree", 0, 3),
            ("ssim_weight", 0, 1),
            ("settle", 0, 1),
            ("coarse", 0, 1),
            ("boost", 1, 100),
            ("seed", 0, MAX_SEED),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise UsageError(f"`{name}`: expected {low} to {high}, got {value}")

    def with_seed(self, otherwise: int | None = None) -> FitConfig:
        """The config with a seed: its own, else `otherwise`, else one from the system's random source."""
        if self.seed is not None:
            return self
        return replace(self, seed=secrets.randbelow(MAX_SEED + 1) if otherwise is None else otherwise)

    @property
    def known_seed(self) -> int:
        """The seed. Raises ValueError without one: see `with_seed`."""
        if self.seed is None:
            raise ValueError("expected a config with a seed: `with_seed` samples one")
        return self.seed

    def seed_of(self, use: str) -> int:
        """A seed for one part of a run, which does not reveal the seeds of other parts."""
        digest = hashlib.sha256(f"keyss/v1/seed {self.known_seed} {use}".encode()).digest()
        return int.from_bytes(digest[:8], "little") & MAX_SEED

    @property
    def refine_every(self) -> int:
        """Steps between two rounds of densification."""
        return self.grow_every or min(100, max(1, self.iterations // 30))

    def sh_degree_at(self, iteration: int) -> int:
        """SH degree in use, which rises every 1,000 iterations or every sixth of a shorter run."""
        return min(self.sh_degree, iteration // max(1, min(1000, self.iterations // 6)))


_FULL = FitConfig(iterations=30_000, max_gaussians=500_000, grow_start=1 / 60, grow_stop=0.5)  # as in 3DGS
PRESETS: dict[str, FitConfig] = {
    "quick": FitConfig(iterations=500, max_gaussians=10_000),
    "default": FitConfig(),
    "full": _FULL,
}
# What people expect of 3DGS on a GPU.
_ON_CUDA = dict.fromkeys(("default", "full"), replace(_FULL, max_gaussians=1_000_000))


def preset_for(size: str, device: str) -> FitConfig:
    """The settings of one of the PRESETS on a device, "cpu" or "cuda". Raises UsageError."""
    if size not in PRESETS:
        raise UsageError(f"preset {size!r}: expected {' or '.join(PRESETS)}")
    return _ON_CUDA.get(size, PRESETS[size]) if device == "cuda" else PRESETS[size]
