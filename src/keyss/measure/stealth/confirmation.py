"""Is this model the one that is hidden in that file? Scores for whoever has a candidate, but no key.

Every score is higher the more the file looks as if it held the candidate. By themselves they mean nothing,
for one candidate resembles all files more than another does: what counts is whether the true one scores
higher than others do, and higher than in files that hold something else (`confirmed`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp, spearmanr

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.opacities import UNDRAWN
from keyss.measure.stealth.words import Floats, Words

MOST = 20_000  # Gaussians of each that are compared
_QUERIES = 4000  # rows for which the nearest are sought
_LEAST_ENERGY = -20.0  # logarithm
_MATCHED = 0.02  # distance of logarithms of energies; of unlike Gaussians hardly one in a thousand is so near
_LOW = 13  # bits that may have been replaced
_LEAST = 50


def candidate_scores(file: Gaussians, candidate: Gaussians) -> dict[str, float]:
    """By name. Models may differ in size and SH degree; orders of rows count, so give them as they are."""
    degree = min(file.sh_degree, candidate.sh_degree)
    file, candidate = (_thinned(each.with_sh_degree(degree)) for each in (file, candidate))
    parts = _parts(file)
    found = {"identical high bits": _identity(file, candidate)}
    if degree:
        found |= _by_rows(_energies(file), _energies(candidate))
    theirs = _marginals(candidate)
    for name, part in parts.items():
        own = _marginals(part)
        found[f"marginals, {name}"] = -float(
            np.mean([ks_2samp(own[key], theirs[key], method="asymp").statistic for key in own])
        )
        found[f"extent, {name}"] = -float(np.abs(np.log(_extent(part) / _extent(candidate))).mean())
        found[f"number, {name}"] = -abs(float(np.log(len(part) / len(candidate))))
    return found


def confirmed(scores: npt.NDArray[np.float64], true: Sequence[int]) -> float:
    """How often the true candidate is ranked above another one, ties counting half; 0.5 is chance.

    `scores` [F, C] of files and candidates, `true` [F] the candidate in each file. Each candidate's scores
    are taken relative to what it has in files that hold something else, and each file's to those of others.
    """
    scores = np.asarray(scores, float)
    own = np.zeros(scores.shape, bool)
    own[np.arange(len(true)), list(true)] = True
    others = np.where(own, np.nan, scores)
    with np.errstate(all="ignore"):
        relative = (
            scores - np.nanmean(others, axis=0) - (np.nanmean(others, axis=1) - np.nanmean(others))[:, None]
        )
    above = []
    for row, index in zip(np.nan_to_num(relative), true, strict=True):
        rest = np.delete(row, index)
        above.append(float((row[index] > rest).mean() + 0.5 * (row[index] == rest).mean()))
    return float(np.mean(above))


def changed_low_bits(file: Gaussians, other: Gaussians) -> float:
    """Share of the Gaussians that `other` has too, but with other low bits: what copies of a cover show."""
    own, theirs = (_high_rows(each, slice(None)) for each in (file, other))
    whole = [{row.tobytes() for row in Words.of(each).bits} for each in (file, other)]
    shared = np.isin(own, theirs)
    rows = Words.of(file).bits[shared]
    same = sum(row.tobytes() in whole[1] for row in rows)
    return float((len(rows) - same) / max(len(file), 1))


def _thinned(model: Gaussians) -> Gaussians:
    return model[:: max(1, -(-len(model) // MOST))]


def _parts(file: Gaussians) -> dict[str, Gaussians]:
    """What of a file a secret may be: all, what is never drawn, what is faint, the end."""
    faint = file.opacity_logits < file.opacity_logits.median()
    parts = {
        "whole": file,
        "never drawn": file[file.opacity_logits < UNDRAWN],
        "faint": file[faint],
        "second half": file[len(file) // 2 :],
    }
    return {name: part if len(part) >= _LEAST else file for name, part in parts.items()}


def _energies(model: Gaussians) -> Floats:
    """[N, 3 degree] logarithms of the energy of each band and channel: no rotation changes it."""
    columns = [
        model.sh[:, band**2 : (band + 1) ** 2].detach().cpu().double().square().sum(1)
        for band in range(1, model.sh_degree + 1)
    ]
    return np.log(np.concatenate([each.numpy() for each in columns], axis=1) + 1e-12)


def _by_rows(own: Floats, theirs: Floats) -> dict[str, float]:
    """Nearest rows: how many fit, how well the better half does, and whether they come in the same order."""
    count = min(len(own), len(theirs))
    at_ends = max(
        _correlation(own[part, 0], theirs[:count, 0]) for part in (slice(0, count), slice(-count, None))
    )
    # Without harmonics all are alike.
    own, theirs = (each[(each > _LEAST_ENERGY).all(axis=1)] for each in (own, theirs))
    own = own[:: max(1, -(-len(own) // _QUERIES))]
    if min(len(own), len(theirs)) < _LEAST:
        return {"rows at the same place": at_ends}
    distance, nearest = cKDTree(theirs).query(own)
    best = distance <= np.quantile(distance, 0.25)
    in_order = _correlation(np.flatnonzero(best), nearest[best])
    return {
        "rows that fit": float((distance < _MATCHED).mean()),
        "nearness of rows, first quarter": -float(np.log(np.quantile(distance, 0.25) + 1e-9)),
        "nearness of rows, median": -float(np.log(np.median(distance) + 1e-9)),
        "order of rows that fit": in_order,
        "rows at the same place": at_ends,
    }


def _correlation(one: npt.NDArray[np.generic], other: npt.NDArray[np.generic]) -> float:
    if len(one) < _LEAST or len(np.unique(one)) < 2 or len(np.unique(other)) < 2:
        return 0.0
    return float(np.nan_to_num(spearmanr(one, other).statistic))


def _high_rows(model: Gaussians, columns: slice) -> npt.NDArray[np.void]:
    """[N] the high bits of each row as one value."""
    high = np.ascontiguousarray(Words.of(model).bits[:, columns] >> _LOW)
    return high.view(f"V{4 * high.shape[1]}")[:, 0]


def _identity(file: Gaussians, candidate: Gaussians) -> float:
    """The largest share of rows with the same high bits, in positions, scales, rotations or harmonics."""
    shares = []
    for columns in (slice(0, 3), slice(3, 6), slice(6, 10), slice(14, None)):
        own, theirs = (_high_rows(each, columns) for each in (file, candidate))
        if own.dtype.itemsize:
            shares.append(float(np.isin(own, theirs).mean()))
    return max(shares)


def _marginals(model: Gaussians) -> dict[str, Floats]:
    """What does not depend on the frame: shapes, energies, colours."""
    scales = np.sort(model.log_scales.detach().cpu().double().numpy(), axis=1)
    found = {
        "flatness": scales[:, 1] - scales[:, 0],
        "elongation": scales[:, 2] - scales[:, 1],
        "brightness": model.sh[:, 0].detach().cpu().double().mean(1).numpy(),
        "length": model.quats.detach().cpu().double().norm(dim=1).numpy(),
    }
    if model.sh_degree:
        found |= {f"energy {index}": column for index, column in enumerate(_energies(model).T)}
    return found


def _extent(model: Gaussians) -> Floats:
    """[2] ratios of the standard deviations along the principal axes: no similarity changes them."""
    means = model.means.detach().cpu().double().numpy()
    middle = means[
        np.linalg.norm(means - np.median(means, axis=0), axis=1).argsort()[: int(0.9 * len(means)) + 2]
    ]
    values = np.sqrt(np.linalg.eigvalsh(np.cov(middle.T)).clip(1e-12))
    ratios: Floats = values[:2] / values[2]
    return ratios
