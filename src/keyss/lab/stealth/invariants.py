"""Properties that tools preserve exactly but embedding only approximately, and the order of rows."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp, rankdata

from keyss.core.arrays import Doubles, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.lab.stealth.statistic import (
    ATTRIBUTES,
    BitPatterns,
    Statistic,
    excess,
    excess_over_smooth,
    normal,
    portion,
)
from keyss.lab.two_sample import space_cells

_UNIT = 5e-7  # error of a length normalised in float32
_MOVED, _AROUND = 2e-4, 2e-3  # maximum change of a length by embedding; range that gives the smooth density
_CELLS = 4  # along each axis
_BLOCKS = 16  # blocks of consecutive rows
_MIN_GAUSSIANS = 30  # minimum Gaussians per part
_CLUSTERED = 0.01  # fraction of the median gap between neighbouring values
_WINDOW = 32
_KS_SPREAD = 0.2603  # standard deviation of Kolmogorov's distribution
_NEAR = 1e-5  # fraction of the model's size


def invariants(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Unit quaternions in the file and its parts, repeated values, clusters, short numbers."""
    statistics = _lengths(model)
    for index, attribute in enumerate(ATTRIBUTES):
        own = words.bits[:, words.of_attribute(index)]
        if not own.size:
            continue
        trained = words.trained[:, words.of_attribute(index)]
        statistics[f"short numbers, {attribute}"] = portion(float((~trained).sum()), trained.size)
        repeated = sum(_count_repeated(own[:, field][trained[:, field]]) for field in range(own.shape[1]))
        statistics[f"repeated values, {attribute}"] = portion(repeated, own.size)
        clusters = [
            _clusters(own[:, field].view(np.float32).astype(np.float64)) for field in range(own.shape[1])
        ]
        hits, trials = (sum(each) for each in zip(*clusters, strict=True))
        statistics[f"clusters of values, {attribute}"] = excess(hits, trials, _CLUSTERED)
    return statistics


def _lengths(model: Gaussians) -> dict[str, Statistic]:
    """Shares of quaternions of exactly and nearly unit length, in the file and in its parts."""
    error = (model.quats.detach().cpu().double().norm(dim=1) - 1).abs().numpy()
    unit = error < _UNIT
    nearly = int((~unit & (error < _MOVED)).sum())
    around = int(((error >= _MOVED) & (error < _AROUND)).sum())
    statistics = {
        "quaternions of unit length": portion(float(unit.sum()), len(unit)),
        "quaternions of nearly unit length": excess_over_smooth(
            nearly, max(around, 1) * _MOVED / (_AROUND - _MOVED), len(unit)
        ),
        "distance of quaternions from unit length, median": Statistic(
            float(np.log10(np.median(error) + 1e-9))
        ),
    }
    for name, part in (
        ("space", space_cells(doubles(model.means), _CELLS)),
        ("rows", np.arange(len(unit)) * _BLOCKS // len(unit)),
    ):
        count, hits = np.bincount(part), np.bincount(part, weights=unit)
        shares = (hits / np.maximum(count, 1))[count >= _MIN_GAUSSIANS]
        spread = float(shares.max() - shares.min()) if len(shares) else 0.0
        statistics[f"unit quaternions in parts of {name}, range of shares"] = Statistic(spread)
    return statistics


def _count_repeated(values: Words32) -> int:
    """Number of values that are not unique."""
    _, counts = np.unique(values, return_counts=True)
    return int(counts[counts > 1].sum())


def _clusters(values: Doubles) -> tuple[int, int]:
    """Number of gaps between sorted values far smaller than their neighbours, and number of gaps.

    For a smooth density, gaps / mean gap is exponential: one in a hundred is below 0.01.
    """
    ordered = np.unique(values)
    if len(ordered) < 4 * _WINDOW:
        return 0, 0
    gaps = np.diff(ordered)
    sums = np.concatenate([[0.0], gaps.cumsum()])
    starts = np.clip(np.arange(len(gaps)) - _WINDOW // 2, 0, len(gaps) - _WINDOW)
    around = (sums[starts + _WINDOW] - sums[starts] - gaps) / (_WINDOW - 1)
    return int((gaps < _CLUSTERED * around).sum()), len(gaps)


def order(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Correlations of the content of rows with their index, and differences of halves; null: random order.

    Plain models have an order too, from density control: compared with controls, a shuffled file is as
    unusual as one with a second model at its end.
    """
    statistics: dict[str, Statistic] = {}
    count = len(model)
    if count < 100:
        return statistics
    rows = np.arange(count)
    for name, values in _columns(model).items():
        ranks = rankdata(values)
        correlation = float(np.corrcoef(rows, ranks)[0, 1]) if np.ptp(values) > 0 else 0.0
        statistics[f"row and {name}, correlation"] = normal(correlation, 1 / math.sqrt(count - 1))
        half = ks_2samp(values[: count // 2], values[count // 2 :], method="asymp")
        statistics[f"halves of rows, {name}"] = Statistic(
            float(half.statistic), _KS_SPREAD * math.sqrt(4 / count), float(half.pvalue)
        )
        jumps = np.abs(np.diff(ranks)).mean() / count
        statistics[f"neighbouring rows, {name}"] = normal(float(jumps), 0.2236 / math.sqrt(count), 1 / 3)
    positions = doubles(model.means)
    size = float(np.linalg.norm(np.subtract(*np.quantile(positions, (0.9, 0.1), axis=0)))) or 1.0
    statistics["near duplicates"] = portion(_pairs_within(positions, _NEAR * size), count)
    return statistics


def _pairs_within(positions: Doubles, distance: float) -> int:
    """Number of pairs of rows within `distance`; takes linear time for equal rows."""
    places, copies = np.unique(positions, axis=0, return_counts=True)
    tree = cKDTree(places)
    ordered = float(tree.count_neighbors(tree, distance, weights=(copies, copies)))
    return (round(ordered) - len(positions)) // 2


def _columns(model: Gaussians) -> dict[str, Doubles]:
    """[N] properties of each Gaussian by name."""
    positions = model.means.detach().cpu().double()
    contents = {f"position {axis}": positions[:, index] for index, axis in enumerate("xyz")}
    contents["distance"] = (positions - positions.median(0).values).norm(dim=1)
    contents["size"] = model.log_scales.detach().cpu().double().mean(1)
    contents["opacity"] = model.opacity_logits.detach().cpu().double()
    contents["brightness"] = model.sh[:, 0].detach().cpu().double().mean(1)
    contents["length of quaternion"] = model.quats.detach().cpu().double().norm(dim=1)
    if model.sh_degree:
        contents["harmonics"] = model.sh[:, 1:].detach().cpu().double().square().sum((1, 2))
    return {name: np.nan_to_num(values.numpy()) for name, values in contents.items()}
