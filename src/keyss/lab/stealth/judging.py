"""Find unusual statistics of a file, and confirm candidates for its secret, beside controls of its scene.

Scores of a candidate are for an attacker who has one, but no key: higher ones suggest that the file holds it.
Some candidates resemble all files, so a score means something only in comparison: with other candidates, and
with files that hold something else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import ks_2samp, spearmanr

from keyss.core import Gaussians, UsageError
from keyss.core.arrays import Doubles, Numbers, doubles
from keyss.core.neighbours import nearest_neighbours
from keyss.lab.stealth.attributes import (
    INVISIBLE,
    colours,
    invariants,
    invisible_modes,
    opacities,
    order,
    shapes_of,
)
from keyss.lab.stealth.low_bits import agreement, bits, coincidences, steps
from keyss.lab.stealth.statistic import BitPatterns, Statistic

# Detectors by kind: functions of a model and its bit patterns that give statistics by name.
KINDS: dict[str, Callable[[Gaussians, BitPatterns], dict[str, Statistic]]] = {
    each.__name__: each
    for each in (bits, agreement, coincidences, steps, invariants, opacities, order, colours)
}
_AGREEMENT = 0.03  # relative error assumed for a statistic without a known error
_MANY = 1e7  # degrees of freedom: normal

MAX_GAUSSIANS = 20_000  # Gaussians per model
_QUERIES = 4000  # rows for nearest-neighbour searches
_MIN_ENERGY = -20.0  # logarithm
_MATCHED = 0.02  # distance of logarithms of energies; chance is below one in a thousand
_LOW = 13  # bits that may have been replaced
_MIN_COUNT = 50


@dataclass(frozen=True)
class JudgedStatistic:
    """A statistic of the file, and of control models."""

    name: str  # "kind: what is counted"
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
    least_of_controls: float  # the minimum for a control judged by the others
    # For each secret: scores of its model against the file, judged by those against the controls. None: the
    # secret has no model.
    confirmations: tuple[tuple[JudgedStatistic, ...] | None, ...] = ()
    invisible_groups: int = 0  # modes of invisible opacities: countable secrets
    changed_low_bits: float = 0.0  # share of the Gaussians that differ from the cover's model in low bits

    @property
    def least_confirmation(self) -> float:
        """The minimum p-value of confirming a secret, corrected for their number; 1 if there is none."""
        rows = [row for scores in self.confirmations for row in scores or ()]
        return min([1.0, *(row.p * len(rows) for row in rows)])


def stealth_statistics(model: Gaussians) -> dict[str, Statistic]:
    """Statistics of one file by "kind: name", if there is enough data; kinds are KINDS.

    Takes half a second for 10,000 Gaussians.
    """
    words = BitPatterns.of(model)
    return {
        f"{kind}: {name}": statistic
        for kind, detect in KINDS.items()
        for name, statistic in detect(model, words).items()
        if not math.isnan(statistic.value)
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
    own = stealth_statistics(file)
    others = [stealth_statistics(model) for model in controls]
    rows = _rows(own, others)
    among_controls = [1.0]
    if len(controls) > 2:
        among_controls = [
            _least(_rows(each, others[:index] + others[index + 1 :])) for index, each in enumerate(others)
        ]
    return StealthResult(
        statistics=tuple(rows),
        least=_least(rows),
        least_of_controls=min(among_controls),
        confirmations=tuple(
            None if candidate is None else _confirmation(file, controls, candidate)
            for candidate in candidates
        ),
        invisible_groups=len(invisible_modes(file)),
        changed_low_bits=0.0 if original is None else changed_low_bits(file, original),
    )


def _confirmation(
    file: Gaussians, controls: Sequence[Gaussians], candidate: Gaussians
) -> tuple[JudgedStatistic, ...]:
    own, *others = (
        {f"candidate: {name}": Statistic(score) for name, score in candidate_scores(model, candidate).items()}
        for model in (file, *controls)
    )
    return tuple(_rows(own, others))


def _rows(own: Mapping[str, Statistic], controls: Sequence[Mapping[str, Statistic]]) -> list[JudgedStatistic]:
    """The statistics that all models have, the least likely first."""
    models = [own, *controls]
    samples = {
        name: [each[name] for each in controls]
        for name in own
        if all(name in each and math.isfinite(each[name].value) for each in models)
    }
    # Variance of the statistics of bits between trainings / sampling variance.
    ratios = [
        _between(others) / _sampling(others)
        for name, others in samples.items()
        if name.startswith("bits: ") and _sampling(others)
    ]
    excess = max(1.0, float(np.mean(ratios))) if ratios else None
    rows = []
    for name, others in samples.items():
        values = [each.value for each in others]
        p = _p(own[name], others, excess if name.startswith("bits: ") else None)
        rows.append(JudgedStatistic(name, own[name].value, min(values), max(values), p, own[name].p))
    return sorted(rows, key=lambda row: row.p)


def _least(rows: Sequence[JudgedStatistic]) -> float:
    """The minimum p with Bonferroni's correction, which is valid for dependent statistics."""
    return min(1.0, rows[0].p * len(rows)) if rows else 1.0


def _p(own: Statistic, controls: Sequence[Statistic], excess: float | None) -> float:
    """Two-sided p of one more value by Student's t, with degrees of freedom by Welch and Satterthwaite.

    Variance between controls and sampling variance add up. Few controls estimate the former poorly: if
    similar statistics have `excess` times their sampling variance, and this one at most three times that,
    `excess` gives its variance.
    """
    from scipy.special import stdtr  # slow to import

    count = len(controls)
    mean = float(np.mean([each.value for each in controls]))
    distance = abs(own.value - mean)
    if distance == 0:
        return 1.0
    between, sampling = _between(controls), _sampling(controls)
    sampling_own = (own.error or 0.0) ** 2
    if excess is not None and between <= 3 * excess * sampling:
        variance, degrees = excess * (sampling_own + sampling / count), _MANY
    else:
        # Few controls may agree by chance, and a constant statistic has no variance.
        floor = (_AGREEMENT * max(abs(mean), 1e-3)) ** 2 if sampling + sampling_own == 0 else 0.0
        unknown = between * (1 + 1 / count) + floor
        variance = unknown + sampling_own + sampling / count
        degrees = min(_MANY, (count - 1) * variance**2 / max(unknown, 1e-150) ** 2)
    return float(2 * stdtr(degrees, -distance / math.sqrt(variance)))


def _between(controls: Sequence[Statistic]) -> float:
    return float(np.var([each.value for each in controls], ddof=1))


def _sampling(controls: Sequence[Statistic]) -> float:
    return float(np.mean([(each.error or 0.0) ** 2 for each in controls]))


def candidate_scores(file: Gaussians, candidate: Gaussians) -> dict[str, float]:
    """Scores by name. Models may differ in size and SH degree; some scores depend on the order of rows."""
    degree = min(file.sh_degree, candidate.sh_degree)
    file, candidate = (
        each.with_sh_degree(degree)[:: max(1, -(-len(each) // MAX_GAUSSIANS))] for each in (file, candidate)
    )
    parts = _parts(file)
    scores = {"identical high bits": _identity(file, candidate)}
    if degree:
        scores |= _by_rows(_energies(file), _energies(candidate))
    theirs = _marginals(candidate)
    for name, part in parts.items():
        own = _marginals(part)
        scores[f"marginals, {name}"] = -float(
            np.mean([ks_2samp(own[key], theirs[key], method="asymp").statistic for key in own])
        )
        scores[f"extent, {name}"] = -float(np.abs(np.log(_extent(part) / _extent(candidate))).mean())
        scores[f"number, {name}"] = -abs(float(np.log(len(part) / len(candidate))))
    return scores


def changed_low_bits(file: Gaussians, other: Gaussians) -> float:
    """Share of the Gaussians that have an equal in `other` except for low bits."""
    shared, same = (
        np.isin(_high_rows(file, slice(None), low), _high_rows(other, slice(None), low)) for low in (_LOW, 0)
    )
    return float((shared & ~same).sum() / max(len(file), 1))


def _parts(file: Gaussians) -> dict[str, Gaussians]:
    """Parts of a file that may be a secret: all, invisible, faint, and the second half."""
    faint = file.opacity_logits < file.opacity_logits.median()
    parts = {
        "whole": file,
        "invisible": file[file.opacity_logits < INVISIBLE],
        "faint": file[faint],
        "second half": file[len(file) // 2 :],
    }
    return {name: part if len(part) >= _MIN_COUNT else file for name, part in parts.items()}


def _energies(model: Gaussians) -> Doubles:
    """[N, 3 degree] logarithms of the energy of each band and channel, invariant to rotation."""
    columns = [
        model.sh[:, band**2 : (band + 1) ** 2].detach().cpu().double().square().sum(1)
        for band in range(1, model.sh_degree + 1)
    ]
    return np.log(np.concatenate([each.numpy() for each in columns], axis=1) + 1e-12)


def _by_rows(own: Doubles, theirs: Doubles) -> dict[str, float]:
    """Scores from nearest rows: share of matches, distances of the best, correlation of their order."""
    count = min(len(own), len(theirs))
    at_ends = max(
        _correlation(own[part, 0], theirs[:count, 0]) for part in (slice(0, count), slice(-count, None))
    )
    # Gaussians without harmonics match each other.
    own, theirs = (each[(each > _MIN_ENERGY).all(axis=1)] for each in (own, theirs))
    own = own[:: max(1, -(-len(own) // _QUERIES))]
    if min(len(own), len(theirs)) < _MIN_COUNT:
        return {"rows at the same place": at_ends}
    distance, nearest = (each[:, 0] for each in nearest_neighbours(own, 1, theirs))
    best = distance <= np.quantile(distance, 0.25)
    in_order = _correlation(np.flatnonzero(best), nearest[best])
    return {
        "rows that fit": float((distance < _MATCHED).mean()),
        "nearness of rows, first quarter": -float(np.log(np.quantile(distance, 0.25) + 1e-9)),
        "nearness of rows, median": -float(np.log(np.median(distance) + 1e-9)),
        "order of rows that fit": in_order,
        "rows at the same place": at_ends,
    }


def _correlation(one: Numbers, other: Numbers) -> float:
    if len(one) < _MIN_COUNT or len(np.unique(one)) < 2 or len(np.unique(other)) < 2:
        return 0.0
    return float(np.nan_to_num(spearmanr(one, other).statistic))


def _high_rows(model: Gaussians, columns: slice, low: int = _LOW) -> Numbers:
    """[N] rows without their `low` lowest bits, each as one value."""
    high = np.ascontiguousarray(BitPatterns.of(model).bits[:, columns] >> low)
    return high.view(f"V{4 * high.shape[1]}")[:, 0]


def _identity(file: Gaussians, candidate: Gaussians) -> float:
    """The largest share of rows with the same high bits, in positions, scales, rotations or harmonics."""
    shares = []
    for columns in (slice(0, 3), slice(3, 6), slice(6, 10), slice(14, None)):
        own, theirs = (_high_rows(each, columns) for each in (file, candidate))
        if own.dtype.itemsize:
            shares.append(float(np.isin(own, theirs).mean()))
    return max(shares)


def _marginals(model: Gaussians) -> dict[str, Doubles]:
    """Frame-independent quantities: shapes, energies, colours."""
    shapes = shapes_of(model) | {"brightness": doubles(model.sh[:, 0]).mean(1)}
    kept = "flatness", "elongation", "brightness", "length of quaternions"
    marginals = {name: shapes[name] for name in kept}
    if model.sh_degree:
        marginals |= {f"energy {index}": column for index, column in enumerate(_energies(model).T)}
    return marginals


def _extent(model: Gaussians) -> Doubles:
    """[2] ratios of the standard deviations along the principal axes, invariant to similarities."""
    means = doubles(model.means)
    middle = means[
        np.linalg.norm(means - np.median(means, axis=0), axis=1).argsort()[: int(0.9 * len(means)) + 2]
    ]
    values = np.sqrt(np.linalg.eigvalsh(np.cov(middle.T)).clip(1e-12))
    ratios: Doubles = values[:2] / values[2]
    return ratios
