"""What a training run can be told, with defaults that suit most scenes."""

from __future__ import annotations

from dataclasses import dataclass

from keyss.core.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Plain 3DGS (Kerbl et al. 2023, section 5 and appendix), its schedule in fractions of the run.

    Fractions instead of the original's absolute step numbers keep short runs whole: 3,000 iterations
    grow, reach full SH degree and settle just as 30,000 do.
    """

    iterations: int = 3000
    max_gaussians: int = 30_000  # cap; pruning always makes room below it
    sh_degree: int = 3
    ssim_weight: float = 0.2  # lambda of the photometric loss
    seed: int = 0

    means_rate: float = 1.6e-4  # times the scene's extent, decays to 1 % of it
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 5e-2
    sh0_rate: float = 2.5e-3
    shN_rate: float = 1.25e-4

    grow_start: float = 1 / 6  # densification begins here, or at 500 iterations if that is earlier
    grow_stop: float = 0.6
    grow_every: int = 100
    grow_gradient: float = 2e-4  # mean screen-space gradient norm above which a Gaussian is cloned or split
    prune_opacity: float = 5e-3

    evaluate_every: int = 500
    checkpoint_seconds: float = 180.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("iterations", 1, 10**7),
            ("max_gaussians", 16, 10**8),
            ("sh_degree", 0, 3),
            ("ssim_weight", 0, 1),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"`{name}`: expected {low} to {high}, got {value}")

    def sh_degree_at(self, iteration: int) -> int:
        """SH degree in use: one more every 1,000 iterations or every sixth of a shorter run."""
        return min(self.sh_degree, iteration // max(1, min(1000, self.iterations // 6)))


PRESETS: dict[str, FitConfig] = {
    "quick": FitConfig(iterations=1000, max_gaussians=10_000),
    "default": FitConfig(),
    "paper": FitConfig(iterations=30_000, max_gaussians=500_000, grow_start=1 / 60, grow_stop=0.5),
}
