"""Find unusual statistics of a file, beside controls of its scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from keyss.channels import DEEPEST
from keyss.core import Gaussians, UsageError
from keyss.core.arrays import Numbers
from keyss.lab.stealth import attributes, low_bits
from keyss.lab.stealth.attributes import invisible_modes
from keyss.lab.stealth.statistic import BitPatterns, Statistic

DETECTORS = (*low_bits.DETECTORS, *attributes.DETECTORS)
_AGREEMENT = 0.03  # relative error assumed for a statistic without a known error
_MANY = 1e7  # degrees of freedom: normal
_BITS = f"{low_bits.bits.__name__}: "  # prefix of the statistics of single bits, whose variances agree


@dataclass(frozen=True)
class JudgedStatistic:
    """A statistic of the file, and of control models."""

    name: str  # "detector: what is counted"
    value: float
    low: float  # minimum of the controls
    high: float  # maximum of the controls
    p: float  # chance that another control model is as far from the mean of the controls
    exact: float | None  # p-value of the file alone under the statistic's own null, if it has one


@dataclass(frozen=True)
class StealthResult:
    """What an attacker with the source code, but no key, finds in the file."""

    statistics: tuple[JudgedStatistic, ...]  # the least likely first
    least: float  # minimum of the p-values, corrected for their number
    least_of_controls: float  # for a control judged by the others, corrected for the number of controls too
    least_of_original: float = 1.0  # for the cover's own plain model
    invisible_groups: int = 0  # modes of invisible opacities: countable secrets
    changed_low_bits: float = 0.0  # share of the Gaussians that differ from the cover's model in low bits


def stealth_statistics(model: Gaussians) -> dict[str, Statistic]:
    """Statistics of one file by "detector: name", if there is enough data.

    Takes half a second for 10,000 Gaussians.
    """
    words = BitPatterns.of(model)
    return {
        f"{detect.__name__}: {name}": statistic
        for detect in DETECTORS
        for name, statistic in detect(model, words).items()
        if not math.isnan(statistic.value)
    }


def judge(
    file: Gaussians, controls: Sequence[Gaussians], *, original: Gaussians | None = None
) -> StealthResult:
    """Compare a file with plain models of its scene from other seeds.

    `original`: the cover's own plain model. Raises UsageError for fewer than two controls.
    """
    if len(controls) < 2:
        raise UsageError(f"expected at least two control models of the scene, got {len(controls)}")
    statistics = stealth_statistics(file)
    others = [stealth_statistics(model) for model in controls]
    rows = compare_statistics(statistics, others)
    of_controls = (
        compare_statistics(control, others[:index] + others[index + 1 :])
        for index, control in enumerate(others)
        if len(others) > 2
    )
    of_original = [] if original is None else compare_statistics(stealth_statistics(original), others)
    return StealthResult(
        statistics=tuple(rows),
        least=least_p(rows),
        least_of_controls=min(1.0, len(others) * min(map(least_p, of_controls), default=1.0)),
        least_of_original=least_p(of_original),
        invisible_groups=len(invisible_modes(file)),
        changed_low_bits=0.0 if original is None else changed_low_bits(file, original),
    )


def compare_statistics(
    statistics: Mapping[str, Statistic], controls: Sequence[Mapping[str, Statistic]]
) -> list[JudgedStatistic]:
    """The statistics that all models have, the least likely first."""
    models = [statistics, *controls]
    samples = {
        name: [control[name] for control in controls]
        for name in statistics
        if all(name in model and math.isfinite(model[name].value) for model in models)
    }
    # Variance of the statistics of bits between trainings / sampling variance.
    ratios = [
        _between(others) / _sampling(others)
        for name, others in samples.items()
        if name.startswith(_BITS) and _sampling(others)
    ]
    excess = max(1.0, float(np.mean(ratios))) if ratios else None
    rows = []
    for name, others in samples.items():
        values = [statistic.value for statistic in others]
        p = _p(statistics[name], others, excess if name.startswith(_BITS) else None)
        rows.append(
            JudgedStatistic(name, statistics[name].value, min(values), max(values), p, statistics[name].p)
        )
    return sorted(rows, key=lambda row: row.p)


def least_p(rows: Sequence[JudgedStatistic]) -> float:
    """The minimum p with Bonferroni's correction, which is valid for dependent statistics."""
    return min(1.0, rows[0].p * len(rows)) if rows else 1.0


def _p(judged: Statistic, controls: Sequence[Statistic], excess: float | None) -> float:
    """Two-sided p of one more value by Student's t, with degrees of freedom by Welch and Satterthwaite.

    Variance between controls and sampling variance add up. Few controls estimate the former poorly: if
    similar statistics have `excess` times their sampling variance, and this one at most three times that,
    `excess` gives its variance.
    """
    count = len(controls)
    mean = float(np.mean([statistic.value for statistic in controls]))
    distance = abs(judged.value - mean)
    if distance == 0:
        return 1.0
    between, sampling = _between(controls), _sampling(controls)
    sampling_judged = (judged.error or 0.0) ** 2
    if excess is not None and between <= 3 * excess * sampling:
        variance, degrees = excess * (sampling_judged + sampling / count), _MANY
    else:
        # Few controls may agree by chance, and a constant statistic has no variance.
        floor = (_AGREEMENT * max(abs(mean), 1e-3)) ** 2 if sampling + sampling_judged == 0 else 0.0
        unknown = between * (1 + 1 / count) + floor
        variance = unknown + sampling_judged + sampling / count
        degrees = min(_MANY, (count - 1) * variance**2 / max(unknown, 1e-150) ** 2)
    return float(2 * stdtr(degrees, -distance / math.sqrt(variance)))


def _between(controls: Sequence[Statistic]) -> float:
    return float(np.var([statistic.value for statistic in controls], ddof=1))


def _sampling(controls: Sequence[Statistic]) -> float:
    return float(np.mean([(statistic.error or 0.0) ** 2 for statistic in controls]))


def changed_low_bits(file: Gaussians, other: Gaussians) -> float:
    """Share of the Gaussians that have an equal in `other` except for low bits."""
    words, theirs = (BitPatterns.of(model).bits for model in (file, other))
    shared, same = (np.isin(_as_values(words >> low), _as_values(theirs >> low)) for low in (DEEPEST + 1, 0))
    return float((shared & ~same).sum() / max(len(file), 1))


def _as_values(rows: Numbers) -> Numbers:
    """[N] the rows [N, F], each as one value."""
    return np.ascontiguousarray(rows).view(f"V{4 * rows.shape[1]}")[:, 0]
