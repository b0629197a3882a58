"""What changes of a published model cost its cover and its secrets, and which breaks down first."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Literal, TypeVar

from keyss.core.errors import BackendError, InputError, KeyssError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import quality, subsample_views
from keyss.measure.robustness import changes as change
from keyss.measure.robustness.changes import Change
from keyss.measure.robustness.conversions import converters
from keyss.methods.opened import Opened

PRUNED = (0.05, 0.10, 0.15, 0.25, 0.50)
NOISE = (0.001, 0.01, 0.1)
DRAWS = 3  # of random removals, which vary by a dB or two
BROKEN_LOSS = 6.0  # dB: four times the squared error
UNCHANGED = "none"

First = Literal["cover", "secret", "both", "neither"]
K = TypeVar("K", bound=Hashable)


@dataclass(frozen=True)
class Reopened:
    """A revealed secret."""

    gaussians: Gaussians  # in the secret's own frame
    frame: Similarity = field(default_factory=Similarity.identity)  # from there into the cover's


# Raises KeyssError if the secret does not open.
Reopen = Callable[[Gaussians], Reopened]


@dataclass(frozen=True)
class Reopener:
    """Reveals a secret as `keyss reveal` does, with `--force` if the model requires it."""

    key: str = field(repr=False)
    open: Callable[[Gaussians, str], Opened] = field(repr=False)  # stego model on the CPU, key

    def __call__(self, stego: Gaussians) -> Reopened:
        """Raises WrongKeyError and InputError as `open` does."""
        stego = stego.to("cpu")
        secret = self.open(stego, self.key)
        try:
            revealed = secret.reveal(stego)
        except InputError:  # positions changed: it seems to be another model
            revealed = secret.reveal(stego, force=True)
        return Reopened(revealed, secret.frame or Similarity.identity())


@dataclass(frozen=True)
class ChangedQuality:
    """A scene against its test photos after a change."""

    psnr: float  # dB
    ssim: float
    loss: float  # dB of PSNR less than in the unchanged model
    opens: bool = True  # always so for the cover
    error: str | None = None  # why a secret does not open


@dataclass(frozen=True)
class ChangeResult:
    """What a change of the published model costs.

    If a secret does not open, its quality is that of the changed model itself, from the secret's cameras.
    """

    attack: str  # changes of one attack differ in strength only
    strength: float
    unit: str
    sentence: str
    seed: int | None
    skipped: str | None = None  # which tool is missing; then the fields below are unset
    gaussians: int | None = None
    cover: ChangedQuality | None = None
    secrets: tuple[ChangedQuality, ...] = ()
    draws: int = 1


@dataclass(frozen=True)
class StrengthLosses:
    """Losses in dB at one strength of an attack."""

    strength: float
    cover: float
    secret: float  # the maximum over the secrets


@dataclass(frozen=True)
class BreakdownPoint:
    """The first strength of an attack that breaks the cover and the secret; None: no strength tried does.

    A scene is broken if it has lost 6 dB or more, and a secret also if it does not open.
    """

    attack: str
    unit: str
    losses: tuple[StrengthLosses, ...]  # means over draws, in the order of the attack's strengths
    secret: float | None
    cover: float | None
    first: First  # what is broken at the first strength that breaks anything
    excess: float | None  # dB: the maximum that the secret loses more than the unbroken cover


def default_changes(cover: Scene, *, seed: int = 0) -> list[Change]:
    """All changes, grouped by attack, the mildest first; some train on the photos of `cover`."""
    return [
        *(change.random_pruning(share, seed + draw) for share in PRUNED for draw in range(DRAWS)),
        *(change.opacity_pruning(share) for share in PRUNED),
        *(change.cropping(seed + draw) for draw in range(DRAWS)),
        *(change.fewer_harmonics(degree) for degree in (2, 1, 0)),
        change.half_floats(),
        *(change.noise(attribute, strength, seed) for attribute in change.NOISY for strength in NOISE),
        *(converter.change() for converter in converters()),
        *(change.purification(cover, given_up, seed=seed) for given_up in (0.0, 0.01)),
        change.fine_tuning(cover, seed=seed),
    ]


def measure_robustness(
    stego: Gaussians,
    reopen: Sequence[Reopen],  # one for each secret: a `Reopener`, or another method's
    cover: Scene,
    secrets: Sequence[Scene],
    *,
    changes: Sequence[Change] | None = None,
    views: int = 8,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[ChangeResult]:
    """Qualities of cover and secrets after each of the `changes`; the first result is the unchanged model's.

    `changes`: `default_changes` by default, about 50. `views`: the maximum number of test views of each
    scene. `progress`: called with changes done, changes in all, and the next one's name. Renders on the
    device of `stego`. The same seed gives the same numbers. Raises UsageError unless there is one `reopen`
    per secret, and KeyssError for a secret that does not open in the unchanged model.
    """
    if len(reopen) != len(secrets):
        raise UsageError(
            f"expected one way to reopen for each of {len(secrets)} secret(s), got {len(reopen)}"
        )
    changes = default_changes(cover, seed=seed) if changes is None else changes
    same = Change(UNCHANGED, 0, "", "Nothing is changed.", lambda model: model)
    frames = [each(stego).frame for each in reopen]
    results: list[ChangeResult] = []
    before: list[float] | None = None
    for number, each in enumerate([same, *changes]):
        if progress is not None:
            progress(number, len(changes) + 1, f"{each.attack} {each.strength:g} {each.unit}".strip())
        result = ChangeResult(each.attack, each.strength, each.unit, each.sentence, each.seed)
        try:
            changed = each(stego)
        except BackendError as error:
            results.append(replace(result, skipped=f"{error}"))
            continue
        found = [_quality(changed, cover, views)]
        found += [_secret(changed, *parts, views) for parts in zip(reopen, frames, secrets, strict=True)]
        before = before or [now.psnr for now in found]
        lost = [replace(now, loss=was - now.psnr) for now, was in zip(found, before, strict=True)]
        results.append(replace(result, gaussians=len(changed), cover=lost[0], secrets=tuple(lost[1:])))
    if progress is not None:
        progress(len(results), len(results), "")
    return results


def mean_over_draws(results: Sequence[ChangeResult]) -> list[ChangeResult]:
    """Results that differ only in their random draw as one: means, and opened if all opened."""
    groups = _grouped(results, lambda result: (result.attack, result.strength)).values()
    return [
        replace(
            draws[0],
            draws=len(draws),
            cover=_mean(covers) if (covers := [draw.cover for draw in draws if draw.cover]) else None,
            secrets=tuple(map(_mean, zip(*(draw.secrets for draw in draws), strict=False))),
        )
        for draws in groups
    ]


def breakdown_points(
    results: Sequence[ChangeResult], broken_loss: float = BROKEN_LOSS
) -> list[BreakdownPoint]:
    """The losses of each attack among `results`, and where cover and secret break down."""
    known = [result for result in results if result.attack != UNCHANGED and result.cover is not None]
    return [
        _breakdown_point(attack, own, broken_loss)
        for attack, own in _grouped(known, lambda result: result.attack).items()
    ]


def _breakdown_point(attack: str, results: Sequence[ChangeResult], broken_loss: float) -> BreakdownPoint:
    losses, broken = [], []
    for strength, draws in _grouped(results, lambda result: result.strength).items():
        cover = fmean(draw.cover.loss for draw in draws if draw.cover is not None)
        secret = fmean(max(each.loss for each in draw.secrets) for draw in draws)
        opens = all(each.opens for draw in draws for each in draw.secrets)
        losses.append(StrengthLosses(strength, cover, secret))
        broken.append((strength, cover >= broken_loss, secret >= broken_loss or not opens))
    names: dict[tuple[bool, bool], First] = {
        (True, False): "cover",
        (False, True): "secret",
        (True, True): "both",
    }
    return BreakdownPoint(
        attack,
        results[0].unit,
        tuple(losses),
        secret=next((strength for strength, _, secret in broken if secret), None),
        cover=next((strength for strength, cover, _ in broken if cover), None),
        first=next((names[cover, secret] for _, cover, secret in broken if cover or secret), "neither"),
        excess=max((each.secret - each.cover for each in losses if each.cover < broken_loss), default=None),
    )


def _grouped(
    results: Sequence[ChangeResult], key: Callable[[ChangeResult], K]
) -> dict[K, list[ChangeResult]]:
    groups: dict[K, list[ChangeResult]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return groups


def _mean(draws: Sequence[ChangedQuality]) -> ChangedQuality:
    return ChangedQuality(
        fmean(draw.psnr for draw in draws),
        fmean(draw.ssim for draw in draws),
        fmean(draw.loss for draw in draws),
        all(draw.opens for draw in draws),
        next((draw.error for draw in draws if draw.error), None),
    )


def _secret(
    changed: Gaussians, reopen: Reopen, frame: Similarity, scene: Scene, views: int
) -> ChangedQuality:
    try:
        return _quality(reopen(changed).gaussians.to(changed.device), scene, views)
    except KeyssError as error:
        why = "this key opens nothing here" if isinstance(error, WrongKeyError) else f"{error}"
        shown = frame.inverse().apply_gaussians(changed.to("cpu")).to(changed.device)
        return replace(_quality(shown, scene, views), opens=False, error=why)


def _quality(model: Gaussians, scene: Scene, views: int) -> ChangedQuality:
    found = quality(model, subsample_views(scene.test, views), scene.background.to(model.device))
    return ChangedQuality(found.psnr, found.ssim, loss=0.0)
