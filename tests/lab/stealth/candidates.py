"""Scores that confirm a guess of a hidden secret, for an attacker who has a candidate for it, but no key.

Higher scores suggest that the file holds the candidate. Some candidates resemble all files, so a score means
something only in comparison: with other candidates, and with files that hold something else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import ks_2samp, spearmanr

from keyss.core import Gaussians
from keyss.core.arrays import Doubles, Numbers, doubles
from keyss.core.neighbours import nearest_neighbours
from keyss.lab.stealth.attributes import INVISIBLE, shapes_of
from keyss.lab.stealth.judging import compare_statistics, least_p
from keyss.lab.stealth.statistic import BitPatterns, Statistic

MAX_GAUSSIANS = 20_000  # Gaussians per model
_QUERIES = 4000  # rows for nearest-neighbour searches
_MIN_ENERGY = -20.0  # logarithm
_MATCHED = 0.02  # distance of logarithms of energies; chance is below one in a thousand
_LOW = 13  # bits that may have been replaced
_MIN_COUNT = 50


def confirmation_p(file: Gaussians, controls: Sequence[Gaussians], candidate: Gaussians) -> float:
    """The minimum p-value of the candidate's scores, beside those in plain models of the cover."""
    own, *others = (
        {name: Statistic(score) for name, score in candidate_scores(model, candidate).items()}
        for model in (file, *controls)
    )
    return least_p(compare_statistics(own, others))


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
    return np.log(np.concatenate([column.numpy() for column in columns], axis=1) + 1e-12)


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


def _high_rows(model: Gaussians, columns: slice) -> Numbers:
    """[N] rows without their low bits, each as one value."""
    high = np.ascontiguousarray(BitPatterns.of(model).bits[:, columns] >> _LOW)
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
