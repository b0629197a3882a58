"""Open a secret; check the model and how much of the secret survived."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from keyss.channels import copies
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.files.inputs import read_file
from keyss.methods import registry
from keyss.methods.hidden import MAX_COMPANION_BYTES, Frame, HiddenFile, HiddenScene, Recovered
from keyss.runs.files import PathLike

MIN_LEFT = 0.1  # share; pruning compensation stops there, and renders become empty
NOTICED_LOSS = 0.01  # share; pruning compensation begins there
# No known trained or public model has a Gaussian beyond 10 radii or larger than one radius.
_SAMPLE = 200_000  # Gaussians from which the visible part is measured
_FAR, _ENORMOUS = 1000.0, 100.0  # radii of the visible part
_MAX_HARMONIC = 1000.0
_MIN_QUATERNION = 1e-12  # length
_PROBLEMS = {
    "duplicates": "copied from others",
    "no_rotation": "with a quaternion of length 0",
    "far": f"more than {_FAR:,.0f} times as far out as visible ones",
    "enormous": f"more than {_ENORMOUS:,.0f} times as large as the visible part",
    "out_of_range": f"with harmonics beyond {_MAX_HARMONIC:,.0f}",
}


@dataclass(frozen=True)
class Revealed:
    """The scene or the file that a key opened."""

    scene: Gaussians | None  # on the CPU
    recovered: Recovered  # bytes instead of Gaussians for a file
    warnings: tuple[str, ...] = ()  # missing Gaussians
    file: HiddenFile | None = None

    @property
    def gaussians(self) -> Gaussians:
        """The model of the scene. Raises UsageError if the key opens a file."""
        if self.scene is None:
            raise UsageError("this key opens a file, not a scene: see `Revealed.file`")
        return self.scene

    def check_usable(self) -> None:
        """Raise InputError if so little is left that renders would be nearly empty."""
        if self.file is None and self.recovered.share < MIN_LEFT:
            raise InputError(
                f"{count_of(self.recovered)}, too few to render (expected at least {MIN_LEFT:.0%}): the "
                f"others {_CAUSE}; use the file as it was published"
            )


_CAUSE = (
    "were removed from the published file or changed in it, as pruning by opacity, cropping, editing and "
    "converting do"
)


def reveal_secret(
    model: Gaussians,
    key: str | None,
    device: torch.device,
    *,
    frame: Frame = "secret",
    companion: PathLike | None = None,
) -> Revealed:
    """The secret that `key` opens in a stego model, however little is left; raises as `keyss.reveal` does."""
    if companion is None and key is None:
        raise UsageError("expected `key`, or `companion` for a companion file")
    if companion is not None and key is not None:
        raise UsageError("companion files have no keys: whoever has one sees the secret")
    secret = registry.open_secret(model, key) if key is not None else read_companion(companion or "")
    if isinstance(secret, HiddenFile):
        if frame != "secret":
            raise UsageError(f"this key opens a file, {secret.name!r}: `frame` is for scenes, leave it out")
        size = len(secret.data)
        recovered = Recovered(size, size, secret.shards)
        return Revealed(None, recovered, tuple(loss_warnings(recovered)) if size else (), secret)
    revealed = secret.reveal(model.to(device), frame=frame)
    recovered = secret.recovered(revealed)
    return Revealed(revealed, recovered, tuple(loss_warnings(recovered)))


def loss_warnings(recovered: Recovered) -> list[str]:
    """Warnings about an incomplete secret."""
    if recovered.share < 1 - NOTICED_LOSS:
        return [
            f"{count_of(recovered)}: the others {_CAUSE}; the rest was made larger and denser to compensate; "
            "the file as it was published gives the whole secret"
        ]
    if recovered.share > 1 + NOTICED_LOSS:
        return [f"{count_of(recovered)}: Gaussians were copied or changed in the published file"]
    left, shards = recovered.shards or (0, 0)
    if left < shards:
        return [
            f"{shards - left:,} of {shards:,} shards of the secret's payload were lost, and restored: the "
            "published file was changed"
        ]
    return []


def count_of(recovered: Recovered) -> str:
    """A sentence on the Gaussians that are left."""
    if not recovered.hidden:
        return f"{recovered.found:,} Gaussians of the secret were found"
    return f"{recovered.found:,} of {recovered.hidden:,} Gaussians of the secret were found"


def read_companion(path: PathLike) -> HiddenScene:
    """Open the secret in a companion file; see `registry.open_companion`."""
    data = read_file(Path(path), MAX_COMPANION_BYTES)
    try:
        return registry.open_companion(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


@dataclass(frozen=True)
class ModelCheck:
    """Checks of a model, with or without a secret."""

    gaussians: int
    sh_degree: int
    duplicates: int  # visible Gaussians with the position and the red of another
    no_rotation: int  # quaternions of length 0
    far: int  # Gaussians a thousand times as far out as visible ones
    enormous: int  # visible Gaussians a hundred times as large as the visible part
    out_of_range: int  # Gaussians with a harmonic beyond 1000
    problems: tuple[str, ...]


@dataclass(frozen=True)
class SecretCheck:
    """Checks of the secret of a key."""

    found: int
    hidden: int  # 0: unknown
    unit: str  # unit of `found` and `hidden`: Gaussians, or bytes of a hidden file
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Verification:
    """The result of `verify`."""

    path: str
    model: ModelCheck
    secrets: tuple[SecretCheck, ...]  # one per key

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems of the model and of the secrets."""
        return sum((secret.problems for secret in self.secrets), self.model.problems)


def check_model(model: Gaussians) -> ModelCheck:
    """Count values that no trained model has. `model` must be on the CPU and finite."""
    visible = model.opacities >= DRAWN_OPACITY
    seen = visible.nonzero()[:, 0]
    means = (model.means[seen[:: max(1, len(seen) // _SAMPLE)]] if len(seen) else model.means).double()
    middle = means.median(0).values
    radius = max(1e-6, float((means - middle).norm(dim=1).sort().values[int(0.9 * len(means))]))
    harmonics = model.sh.flatten(1)
    duplicates, suspicious = copies(model)
    counts = {
        "duplicates": duplicates,
        "no_rotation": int((model.quats.double().norm(dim=1) < _MIN_QUATERNION).sum()),
        "far": int(((model.means - middle).double().norm(dim=1) > _FAR * radius).sum()),
        "enormous": int((visible & (model.log_scales.amax(1).double().exp() > _ENORMOUS * radius)).sum()),
        "out_of_range": int((torch.maximum(harmonics.amax(1), -harmonics.amin(1)) > _MAX_HARMONIC).sum()),
    }
    wrong = counts if suspicious else counts | {"duplicates": 0}
    problems = [f"{count:,} Gaussians {_PROBLEMS[name]}" for name, count in wrong.items() if count]
    if not visible.any():
        problems.append("all Gaussians are invisible")
    return ModelCheck(len(model), model.sh_degree, **counts, problems=tuple(problems))
