"""Checks of the verb `verify`: for a sound model and a complete secret."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.rendering.orbit import middle_and_radius
from keyss.runs.revealing import Revealed

# Far beyond the values of trained and public models: none has a Gaussian beyond 10 radii or larger than one
# radius; one has 3.5 % duplicates.
_FAR, _ENORMOUS = 1000.0, 100.0  # radii of the visible part
_MAX_DUPLICATES = 0.1  # share
_MAX_HARMONIC = 1000.0
_MIN_QUATERNION = 1e-12  # length


@dataclass(frozen=True)
class ModelCheck:
    """Checks of a model, with or without a secret."""

    gaussians: int
    sh_degree: int
    duplicates: int  # Gaussians that are equal to another one in every value
    unit_quaternions: float  # share of those of length 1; others are valid too
    no_rotation: int  # quaternions of length 0
    far: int  # a thousand times as far out as visible Gaussians
    enormous: int  # visible and a hundred times as large as the visible part
    out_of_range: int  # with harmonics beyond 1000
    problems: tuple[str, ...]


@dataclass(frozen=True)
class SecretCheck:
    """Checks of the secret of a key."""

    found: int  # Gaussians
    hidden: int  # Gaussians in all; 0: unknown
    share: float  # found / hidden
    chunks: int | None  # of its payload; None if it is not divided
    chunks_lost: int | None  # restored from the others
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Verification:
    """The result of `verify`."""

    path: str
    model: ModelCheck
    secret: SecretCheck | None  # None without a key

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems of the secret if there is a key, else of the model."""
        return self.model.problems if self.secret is None else self.secret.problems


def check_model(model: Gaussians) -> ModelCheck:
    """Count values that no trained model has. `model`: on the CPU, all values finite."""
    visible = model.opacities >= DRAWN_OPACITY
    middle, radius = middle_and_radius(model[visible] if visible.any() else model)
    columns = [model.means, model.quats, model.log_scales, model.opacity_logits[:, None], model.sh.flatten(1)]
    lengths = model.quats.double().norm(dim=1)
    counts = {
        "duplicates": len(model) - len(torch.unique(torch.cat(columns, dim=1), dim=0)),
        "no_rotation": int((lengths < _MIN_QUATERNION).sum()),
        "far": int(((model.means - middle).double().norm(dim=1) > _FAR * radius).sum()),
        "enormous": int((visible & (model.log_scales.amax(1).double().exp() > _ENORMOUS * radius)).sum()),
        "out_of_range": int((model.sh.abs().flatten(1).amax(1) > _MAX_HARMONIC).sum()),
    }
    allowed = {"duplicates": int(_MAX_DUPLICATES * len(model))}
    words = {
        "duplicates": "equal to others in every value",
        "no_rotation": "with a quaternion of length 0",
        "far": f"more than {_FAR:,.0f} times as far out as visible ones",
        "enormous": f"more than {_ENORMOUS:,.0f} times as large as the visible part",
        "out_of_range": f"with harmonics beyond {_MAX_HARMONIC:,.0f}",
    }
    problems = [
        f"{count:,} Gaussians {words[name]}" for name, count in counts.items() if count > allowed.get(name, 0)
    ]
    if not visible.any():
        problems.append("all Gaussians are invisible")
    return ModelCheck(
        gaussians=len(model),
        sh_degree=model.sh_degree,
        unit_quaternions=round(float(((lengths - 1).abs() < 1e-3).double().mean()), 4),
        problems=tuple(problems),
        **counts,
    )


def check_secret(revealed: Revealed) -> SecretCheck:
    """Count what is missing of a revealed secret."""
    remains = revealed.remains
    left, chunks = remains.chunks or (None, None)
    lost = None if left is None or chunks is None else chunks - left
    problems = list(revealed.warnings)
    if not remains.whole and not problems:
        problems.append(f"{remains.found:,} of {remains.hidden:,} Gaussians of the secret were found")
    if lost:
        problems.append(f"{lost:,} of {chunks:,} chunks of its payload are lost and were restored")
    return SecretCheck(
        found=remains.found,
        hidden=remains.hidden,
        share=round(remains.share, 4),
        chunks=chunks,
        chunks_lost=lost,
        problems=tuple(problems),
    )
