"""PSNR loss of cover and secrets when the published model changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from keyss.core.errors import BackendError, KeyssError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import mean_psnr, subsample_views
from keyss.lab.robustness import changes as change
from keyss.lab.robustness.changes import Change
from keyss.lab.robustness.converters import converters
from keyss.measure.hide_quality import in_cover
from keyss.methods.hidden import HiddenScene
from keyss.progress import Share

PRUNED = (0.05, 0.10, 0.15, 0.25, 0.50)
NOISE = (0.001, 0.01, 0.1)
SEEDS = 3  # repetitions per random removal; results vary by a dB or two

# Opens a secret in a stego model on the CPU; raises KeyssError if it does not open.
Opener = Callable[[Gaussians], HiddenScene]


@dataclass(frozen=True)
class ChangedQuality:
    """A scene against its test photos after a change."""

    psnr: float  # dB
    loss: float  # dB below the unchanged model
    opens: bool = True  # always True for the cover
    error: str | None = None  # why a secret does not open


@dataclass(frozen=True)
class ChangeResult:
    """Quality of cover and secrets after a change of the published model: means over its random seeds.

    If a secret does not open, its quality is that of the changed model itself, from the secret's cameras.
    """

    attack: str  # changes of one attack differ in strength only
    strength: float
    sentence: str
    seeds: int = 1  # number of changes averaged
    skipped: str | None = None  # the missing tool; `cover` and `secrets` are unset then
    cover: ChangedQuality | None = None
    secrets: tuple[ChangedQuality, ...] = ()


def default_changes(cover: Scene, *, seed: int = 0) -> list[Change]:
    """All changes, grouped by attack, mildest first; some train on the photos of `cover`."""
    return [
        *(change.random_pruning(share, seed + index) for share in PRUNED for index in range(SEEDS)),
        *(change.opacity_pruning(share) for share in PRUNED),
        *(change.cropping(seed + index) for index in range(SEEDS)),
        *(change.fewer_harmonics(degree) for degree in (2, 1, 0)),
        change.half_floats(),
        *(change.noise(attribute, strength, seed) for attribute in change.NOISY for strength in NOISE),
        *(converter.change() for converter in converters()),
        *(change.purification(cover, given_up, seed=seed) for given_up in (0.0, 0.01)),
        change.fine_tuning(cover, seed=seed),
    ]


def measure_robustness(
    stego: Gaussians,
    openers: Sequence[Opener],  # one for each secret
    scenes: Sequence[Scene],  # the cover, then the secrets
    *,
    changes: Sequence[Change] | None = None,
    max_views: int = 8,
    seed: int = 0,
    share: Share | None = None,
) -> list[ChangeResult]:
    """PSNRs of cover and secrets after each of the `changes`; the first result is the unchanged model's.

    `changes`: by default `default_changes`, about 50; results of equal attack and strength are averaged.
    `max_views`: test views per scene. `share`: called with the share of the work that is done. Renders on the
    device of `stego`. Deterministic in `seed`. Raises UsageError unless there is one opener per secret,
    KeyssError if a secret does not open in the unchanged model.
    """
    cover, *secrets = scenes
    if len(openers) != len(secrets):
        raise UsageError(f"expected an opener for each of {len(secrets)} secret(s), got {len(openers)}")
    changes = default_changes(cover, seed=seed) if changes is None else changes
    opened = [opener(stego.to("cpu")) for opener in openers]
    placed = [in_cover(*pair, cover) for pair in zip(opened, secrets, strict=True)]

    def psnr(model: Gaussians, scene: Scene) -> float:
        return mean_psnr(model, subsample_views(scene.test, max_views), scene.background.to(model.device))

    def secret_quality(model: Gaussians, index: int) -> ChangedQuality:
        try:
            changed = model.to("cpu")
            revealed = openers[index](changed).reveal(changed).to(model.device)
        except KeyssError as error:
            why = "this key opens nothing here" if isinstance(error, WrongKeyError) else f"{error}"
            return ChangedQuality(psnr(model, placed[index]), 0.0, opens=False, error=why)
        return ChangedQuality(psnr(revealed, secrets[index]), 0.0)

    results: dict[tuple[str, float], list[ChangeResult]] = {}
    before: list[float] = []
    unchanged = Change("none", 0, "Nothing is changed.", lambda model: model)
    for index, alteration in enumerate([unchanged, *changes]):
        if share is not None:
            share(index / (1 + len(changes)))
        result = ChangeResult(alteration.attack, alteration.strength, alteration.sentence)
        try:
            changed = alteration(stego)
        except BackendError as error:
            result = replace(result, skipped=f"{error}")
        else:
            after = [ChangedQuality(psnr(changed, cover), 0.0)]
            after += [secret_quality(changed, index) for index in range(len(secrets))]
            before = before or [quality.psnr for quality in after]
            lost = [replace(now, loss=was - now.psnr) for now, was in zip(after, before, strict=True)]
            result = replace(result, cover=lost[0], secrets=tuple(lost[1:]))
        results.setdefault((alteration.attack, alteration.strength), []).append(result)
    return [_mean(group) for group in results.values()]


def _mean(results: Sequence[ChangeResult]) -> ChangeResult:
    """Average results of different random seeds."""
    rows = [(result.cover, *result.secrets) for result in results if result.cover is not None]
    if not rows:
        return results[0]
    cover, *secrets = (
        ChangedQuality(
            fmean(quality.psnr for quality in qualities),
            fmean(quality.loss for quality in qualities),
            all(quality.opens for quality in qualities),
            next((quality.error for quality in qualities if quality.error), None),
        )
        for qualities in zip(*rows, strict=True)
    )
    return replace(results[0], seeds=len(results), cover=cover, secrets=tuple(secrets))
