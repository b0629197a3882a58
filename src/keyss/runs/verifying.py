"""The verb `verify`: whether a model is sound, and whether all of a secret is in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.rendering.orbit import middle_and_radius
from keyss.runs.revealing import Revealed

# Far beyond what the trained and public models hold that were looked at: none has a Gaussian beyond 10 radii,
# or larger than one; one has 3.5 % duplicates.
_FAR, _ENORMOUS = 1000.0, 100.0  # radii of what can be seen
_DUPLICATES = 0.1  # of all
_LARGEST = 1000.0  # of a harmonic
_MIN_QUATERNION = 1e-12  # length


@dataclass(frozen=True)
class ModelCheck:
    """A model as such, all of whose values are finite; it does not tell whether something is hidden in it."""

    gaussians: int
    sh_degree: int
    duplicates: int  # Gaussians that are equal to another one in every value
    unit_quaternions: float  # share of those of length 1; others are sound too
    no_rotation: int  # quaternions of length 0
    far: int  # a thousand times further out than what can be seen reaches
    enormous: int  # a hundred times larger than what can be seen, and drawn
    out_of_range: int  # with harmonics beyond 1000
    problems: tuple[str, ...]


@dataclass(frozen=True)
class SecretCheck:
    """The secret of a key."""

    found: int  # Gaussians
    hidden: int  # Gaussians that there were; 0: not known
    share: float  # the one of the other
    chunks: int | None  # of the pieces of its payload; None where it was not cut into pieces
    chunks_lost: int | None  # those lost, which the others made up for
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Verification:
    """What `verify` found."""

    path: str
    model: ModelCheck
    secret: SecretCheck | None  # None without a key

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong: with the secret if there is a key, else with the model."""
        return self.model.problems if self.secret is None else self.secret.problems


def check_model(model: Gaussians) -> ModelCheck:
    """Look for what no trained model holds. `model`: on the CPU, all values finite."""
    drawn = model.opacities >= DRAWN_OPACITY
    middle, radius = middle_and_radius(model[drawn] if drawn.any() else model)
    columns = [model.means, model.quats, model.log_scales, model.opacity_logits[:, None], model.sh.flatten(1)]
    lengths = model.quats.double().norm(dim=1)
    counts = {
        "duplicates": len(model) - len(torch.unique(torch.cat(columns, dim=1), dim=0)),
        "no_rotation": int((lengths < _MIN_QUATERNION).sum()),
        "far": int(((model.means - middle).double().norm(dim=1) > _FAR * radius).sum()),
        "enormous": int((drawn & (model.log_scales.amax(1).double().exp() > _ENORMOUS * radius)).sum()),
        "out_of_range": int((model.sh.abs().flatten(1).amax(1) > _LARGEST).sum()),
    }
    most = {"duplicates": int(_DUPLICATES * len(model))}
    words = {
        "duplicates": "equal to others in every value",
        "no_rotation": "with a quaternion of length 0",
        "far": f"more than {_FAR:,.0f} times as far out as what can be seen",
        "enormous": f"more than {_ENORMOUS:,.0f} times as large as what can be seen",
        "out_of_range": f"with harmonics beyond {_LARGEST:,.0f}",
    }
    problems = [
        f"{found:,} Gaussians {words[name]}" for name, found in counts.items() if found > most.get(name, 0)
    ]
    if not drawn.any():
        problems.append("all Gaussians are too transparent to be drawn")
    return ModelCheck(
        gaussians=len(model),
        sh_degree=model.sh_degree,
        unit_quaternions=round(float(((lengths - 1).abs() < 1e-3).double().mean()), 4),
        problems=tuple(problems),
        **counts,
    )


def check_secret(found: Revealed) -> SecretCheck:
    """What is missing of a secret that was revealed."""
    remains = found.remains
    left, chunks = remains.chunks or (None, None)
    lost = None if left is None or chunks is None else chunks - left
    problems = list(found.warnings)
    if not remains.whole and not problems:
        problems.append(f"{remains.found:,} of {remains.hidden:,} Gaussians of the secret were found")
    if lost:
        problems.append(f"{lost:,} of {chunks:,} chunks of its payload are lost; the others make up for them")
    return SecretCheck(
        found=remains.found,
        hidden=remains.hidden,
        share=round(remains.share, 4),
        chunks=chunks,
        chunks_lost=lost,
        problems=tuple(problems),
    )
