"""Which statistics of a file are unusual, compared with control models of the same scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from keyss.core import Gaussians, UsageError
from keyss.measure.stealth.agreement import agreement
from keyss.measure.stealth.bits import bits
from keyss.measure.stealth.colours import colours
from keyss.measure.stealth.confirmation import candidate_scores, changed_low_bits
from keyss.measure.stealth.invariants import invariants
from keyss.measure.stealth.opacities import UNDRAWN, modes, opacities
from keyss.measure.stealth.order import order
from keyss.measure.stealth.statistic import Statistic
from keyss.measure.stealth.words import Floats, Words, doubles

KINDS = ("bits", "agreement", "invariants", "opacities", "order", "colours")
_AGREEMENT = 0.03  # relative error assumed for a statistic without a known error
_MANY = 1e7  # degrees of freedom: normal


@dataclass(frozen=True)
class JudgedStatistic:
    """A statistic of the file, and of control models."""

    name: str  # "kind: what is counted"
    value: float
    low: float  # minimum of the controls
    high: float  # maximum of the controls
    p: float  # that another control model is as far from the mean of the controls
    exact: float | None  # p-value of the file alone under the statistic's own null, if it has one


@dataclass(frozen=True)
class ConfirmedSecret:
    """Whether a guess of the secret is confirmed: scores of a model of it against the file."""

    scores: tuple[JudgedStatistic, ...]  # controls: the same score against plain models of the cover


@dataclass(frozen=True)
class StealthResult:
    """What an attacker with the source code, but no key, finds in the file alone."""

    statistics: tuple[JudgedStatistic, ...]  # the least likely first
    least: float  # minimum of the p-values, corrected for their number
    least_of_controls: float  # the minimum for a control judged by the others
    confirmations: tuple[ConfirmedSecret | None, ...] = ()  # of each secret; None without a model of it
    groups_never_drawn: int = 0  # modes of the opacities that are never drawn: countable secrets
    changed_low_bits: float = 0.0  # share of the Gaussians that differ from the cover's model in low bits

    @property
    def least_confirmation(self) -> float:
        """The minimum p-value of confirming a secret, corrected for their number; 1 if there is none."""
        rows = [row for each in self.confirmations if each is not None for row in each.scores]
        return min([1.0, *(row.p * len(rows) for row in rows)])


def stealth_statistics(model: Gaussians) -> dict[str, Statistic]:
    """Statistics of one file by "kind: name", if there is enough data; kinds are KINDS.

    Takes half a second for 10,000 Gaussians.
    """
    words = Words.of(model)
    found = {
        "bits": bits(words),
        "agreement": agreement(words, doubles(model.means)),
        "invariants": invariants(model, words),
        "opacities": opacities(model),
        "order": order(model),
        "colours": colours(model),
    }
    return {
        f"{kind}: {name}": each
        for kind, own in found.items()
        for name, each in own.items()
        if not math.isnan(each.value)
    }


def judge(
    file: Gaussians,
    controls: Sequence[Gaussians],
    *,
    original: Gaussians | None = None,
    candidates: Sequence[Gaussians | None] = (),
) -> StealthResult:
    """Compare a file with plain models of its scene from other seeds.

    `original`: the cover's own plain model. `candidates`: a plain model of each secret, if there is one.
    Raises UsageError for fewer than two controls.
    """
    if len(controls) < 2:
        raise UsageError(f"expected at least two control models of the scene, got {len(controls)}")
    changed = 0.0 if original is None else changed_low_bits(file, original)
    own = stealth_statistics(file)
    theirs = [stealth_statistics(each) for each in controls]
    rows = _rows(own, theirs)
    return StealthResult(
        statistics=tuple(rows),
        least=_least(rows),
        least_of_controls=min(
            _least(_rows(each, theirs[:index] + theirs[index + 1 :])) for index, each in enumerate(theirs)
        )
        if len(theirs) > 2
        else 1.0,
        confirmations=tuple(
            None if each is None else _confirmed(file, controls, each) for each in candidates
        ),
        groups_never_drawn=len(modes(_undrawn(file))),
        changed_low_bits=changed,
    )


def _confirmed(file: Gaussians, controls: Sequence[Gaussians], candidate: Gaussians) -> ConfirmedSecret:
    def scores(model: Gaussians) -> dict[str, Statistic]:
        return {
            f"candidate: {name}": Statistic(value)
            for name, value in candidate_scores(model, candidate).items()
        }

    rows = _rows(scores(file), [scores(each) for each in controls])
    return ConfirmedSecret(tuple(rows))


def _rows(own: Mapping[str, Statistic], controls: Sequence[Mapping[str, Statistic]]) -> list[JudgedStatistic]:
    """The statistics that all models have, the least likely first."""
    every = [own, *controls]
    names = [name for name in own if all(name in each and math.isfinite(each[name].value) for each in every)]
    samples = {name: [each[name] for each in controls] for name in names}
    usual: dict[str, list[float]] = {}
    for name, others in samples.items():
        if _sampling(others):
            usual.setdefault(_kind(name), []).append(_between(others) / _sampling(others))
    # How much more statistics of a kind vary between trainings than by sampling.
    excess = {kind: max(1.0, float(np.mean(ratios))) for kind, ratios in usual.items() if kind == "bits"}
    rows = []
    for name, others in samples.items():
        values = [each.value for each in others]
        p = _p(own[name], others, excess.get(_kind(name)))
        rows.append(JudgedStatistic(name, own[name].value, min(values), max(values), p, own[name].p))
    return sorted(rows, key=lambda row: row.p)


def _kind(name: str) -> str:
    return name.split(":")[0]


def _least(rows: Sequence[JudgedStatistic]) -> float:
    """The minimum p with Bonferroni's correction, which is valid for dependent statistics."""
    return min(1.0, rows[0].p * len(rows)) if rows else 1.0


def _p(found: Statistic, controls: Sequence[Statistic], excess: float | None) -> float:
    """Two-sided p by Student's t for one more value; known sampling errors add degrees of freedom.

    The variances between controls and of sampling add up; degrees of freedom by Welch and Satterthwaite. Few
    controls estimate the first one poorly: if statistics of a kind vary by `excess` times their sampling
    variance, and this one by at most three times that, `excess` gives its variance.
    """
    from scipy.special import stdtr  # slow to import

    count = len(controls)
    mean = float(np.mean([each.value for each in controls]))
    apart = abs(found.value - mean)
    if apart == 0:
        return 1.0
    between, sampling = _between(controls), _sampling(controls)
    own = (found.error or 0.0) ** 2
    if excess is not None and between <= 3 * excess * sampling:
        variance, degrees = excess * (own + sampling / count), _MANY
    else:
        # Few controls may agree by chance, and a constant statistic has no variance.
        floor = (_AGREEMENT * max(abs(mean), 1e-3)) ** 2 if sampling + own == 0 else 0.0
        unknown = between * (1 + 1 / count) + floor
        variance = unknown + own + sampling / count
        degrees = min(_MANY, (count - 1) * variance**2 / max(unknown, 1e-150) ** 2)
    return float(2 * stdtr(degrees, -apart / math.sqrt(variance)))


def _between(controls: Sequence[Statistic]) -> float:
    return float(np.var([each.value for each in controls], ddof=1))


def _sampling(controls: Sequence[Statistic]) -> float:
    return float(np.mean([(each.error or 0.0) ** 2 for each in controls]))


def _undrawn(file: Gaussians) -> Floats:
    logits = doubles(file.opacity_logits)
    found: Floats = logits[logits < UNDRAWN]
    return found
