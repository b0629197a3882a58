"""Detectors of what embedding changes beyond low bits.

- `invariants`: properties that tools preserve exactly, but embedding only approximately.
- `order`: the order of rows.
- `colours`: noise in green and blue relative to red, which the channel `colours` does not change. Neighbours
  in space and in rows, often one Gaussian before density control, differ about equally in all three colours.
  Noise in two of them is most noticeable in pairs that differ least, and in small and faint Gaussians.
- `opacities`: hiding Gaussians too faint to render changes the distribution of opacities.
"""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from scipy.signal import find_peaks
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp, rankdata

from keyss.core.arrays import Doubles, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.lab.stealth.statistic import (
    ATTRIBUTES,
    BitPatterns,
    Statistic,
    excess,
    near_misses,
    normal,
    portion,
)
from keyss.lab.two_sample import space_cells

_UNIT = 5e-7  # error of a length normalised in float32
_MOVED, _AROUND = 2e-4, 2e-3  # maximum change of a length by embedding; range that gives the smooth density
_CELLS = 4  # along each axis
_BLOCKS = 16  # blocks of consecutive rows
_MIN_GAUSSIANS = 30  # minimum Gaussians of a part or a mode
_CLUSTERED = 0.01  # fraction of the median gap between neighbouring values
_WINDOW = 32
_KS_SPREAD = 0.2603  # standard deviation of Kolmogorov's distribution
_NEAR = 1e-5  # fraction of the model's size

_QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.9)
_CHANNELS = {"green": 1, "blue": 2}
_PARTS = ("most visible", "more visible", "less visible", "least visible")
_MIN_PAIRS = 200
_TINY = 1e-4  # colour differences below this count as none
INVISIBLE = -5.6  # logits below are never rendered
_SHARES = {
    "logit below -12": (-np.inf, -12.0),
    "logit -12 to -8": (-12.0, -8.0),
    "invisible": (-np.inf, INVISIBLE),
    "visible, below 0.005": (-5.54, -5.293),
    "0.005 to 0.05": (-5.293, -2.944),
    "0.05 to 0.5": (-2.944, 0.0),
    "0.5 to 0.9": (0.0, 2.197),
    "above 0.99": (4.595, np.inf),
}
_FAINT = -2.944
_BANDWIDTH, _STEP = 0.15, 0.05  # logits
_DIP = 0.5  # two modes are separate if the density between them falls to this fraction of the lower one


def invariants(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Unit quaternions in the file and its parts, repeated values, clusters, short numbers."""
    statistics = _lengths(model)
    for index, attribute in enumerate(ATTRIBUTES):
        numbers = words.bits[:, words.of_attribute(index)]
        if not numbers.size:
            continue
        trained = words.trained[:, words.of_attribute(index)]
        statistics[f"short numbers, {attribute}"] = portion((~trained).sum(axis=1), trained.shape[1])
        repeated = np.zeros(len(numbers))
        for values, kept in zip(numbers.T, trained.T, strict=True):
            _, inverse, counts = np.unique(values[kept], return_inverse=True, return_counts=True)
            repeated[kept] += counts[inverse] > 1
        statistics[f"repeated values, {attribute}"] = portion(repeated, numbers.shape[1])
        clusters = [_clusters(values.view(np.float32).astype(np.float64)) for values in numbers.T]
        hits, trials = (sum(counted) for counted in zip(*clusters, strict=True))
        statistics[f"clusters of values, {attribute}"] = excess(hits, trials, _CLUSTERED)
    return statistics


def _lengths(model: Gaussians) -> dict[str, Statistic]:
    """Shares of quaternions of exactly and nearly unit length, in the file and in its parts."""
    error = (model.quats.detach().cpu().double().norm(dim=1) - 1).abs().numpy()
    unit = error < _UNIT
    statistics = {
        "quaternions of unit length": portion(unit),
        "quaternions of nearly unit length": near_misses(error, unit, _MOVED, _AROUND),
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
    pairs = _pairs_within(positions, _NEAR * size)
    statistics["near duplicates"] = Statistic(pairs / count, math.sqrt(max(pairs, 1)) / count)
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


def colours(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Log ratios of differences; 0 if green or blue vary like red."""
    values = np.nan_to_num(doubles(model.sh[:, 0]))
    statistics: dict[str, Statistic] = {}
    if len(values) < _MIN_PAIRS:
        return statistics
    positions = np.nan_to_num(doubles(model.means))
    _, near = nearest_neighbours(positions, 2)
    rows = np.arange(len(values))
    pairs = {"neighbours": np.stack([rows, near[:, 1]], axis=1), "rows": np.stack([rows[1:], rows[:-1]], 1)}
    for name, pair in pairs.items():
        distance = np.abs(values[pair[:, 0]] - values[pair[:, 1]])
        for channel, index in _CHANNELS.items():
            for quantile in _QUANTILES:
                ratio = _ratio(distance[:, index], distance[:, 0], quantile)
                statistics[f"{channel} of {name}, {quantile}"] = ratio
            close = distance[distance[:, 0] <= np.quantile(distance[:, 0], 0.1)]
            ratio = _ratio(close[:, index], distance[:, index], 0.5)
            statistics[f"{channel} of {name} with the same red"] = ratio
    # Quarters of the rows by the visibility of a colour change: area times squared opacity.
    areas = model.log_scales.detach().cpu().double().sort(dim=1).values[:, 1:].sum(dim=1)
    shown = (areas + 2 * model.opacities.detach().cpu().double().clamp_min(1e-6).log()).numpy()
    quarters = np.array_split(np.argsort(-np.nan_to_num(shown), kind="stable"), 4)
    for name, part in zip(_PARTS, quarters, strict=True):
        distance = np.abs(values[part] - values[near[part, 1]])
        for channel, index in _CHANNELS.items():
            statistics[f"{channel} of neighbours, {name}"] = _ratio(distance[:, index], distance[:, 0], 0.25)
    channels = zip(("red", "green", "blue"), values.T, strict=True)
    inside = {f"{a} and {b}": np.abs(one - two) for (a, one), (b, two) in combinations(channels, 2)}
    usual = np.median(np.stack(list(inside.values())), axis=1).mean()
    for name, difference in inside.items():
        for quantile in _QUANTILES[:2]:
            statistics[f"{name}, {quantile}"] = Statistic(
                float(np.log((np.quantile(difference, quantile) + _TINY) / (usual + _TINY)))
            )
    return statistics


def _ratio(one: Doubles, other: Doubles, quantile: float) -> Statistic:
    first, second = np.quantile(one, quantile), np.quantile(other, quantile)
    return Statistic(float(np.log((first + _TINY) / (second + _TINY))))


def opacities(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Shares of ranges of opacity, and differences between faint and other Gaussians."""
    logits = doubles(model.opacity_logits)
    statistics = {
        f"share of opacities, {name}": portion((logits >= low) & (logits < high))
        for name, (low, high) in _SHARES.items()
    }
    statistics["modes of faint opacities"] = Statistic(float(len(_modes(logits[logits < _FAINT]))))
    faint = logits < _FAINT
    for name, values in shapes_of(model).items():
        few = min(faint.sum(), (~faint).sum()) < _MIN_GAUSSIANS
        parted = np.nan if few else float(np.median(values[faint]) - np.median(values[~faint]))
        statistics[f"faint against opaque, {name}"] = Statistic(parted)
        statistics[f"median {name}"] = Statistic(float(np.median(values)))
        statistics[f"spread of {name}"] = Statistic(float(np.subtract(*np.quantile(values, (0.9, 0.1)))))
    return statistics


def invisible_modes(model: Gaussians) -> list[float]:
    """Peaks in the density of invisible opacity logits, one per group hidden there."""
    logits = doubles(model.opacity_logits)
    return _modes(logits[logits < INVISIBLE])


def _modes(logits: Doubles) -> list[float]:
    """Separate peaks of the density of opacity logits [N]."""
    if len(logits) < _MIN_GAUSSIANS:
        return []
    low, high = logits.min() - 1, logits.max() + 1
    edges = np.arange(low, high + _STEP, _STEP)
    counts = np.histogram(logits, edges)[0].astype(float)
    reach = int(4 * _BANDWIDTH / _STEP)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * _STEP / _BANDWIDTH) ** 2)
    density = np.convolve(counts, kernel, mode="same")
    # A peak must fall to _DIP of its height on both sides, or to the end.
    margins = np.pad(density, 1)
    peaks, properties = find_peaks(margins, height=_MIN_GAUSSIANS / 2, prominence=0)
    separate = properties["prominences"] >= (1 - _DIP) * properties["peak_heights"]
    return [float(edges[at - 1] + _STEP / 2) for at in peaks[separate]]


def shapes_of(model: Gaussians) -> dict[str, Doubles]:
    """[N] size, shape and energies of each Gaussian by name."""
    scales = doubles(model.log_scales)
    ordered = np.sort(scales, axis=1)
    lengths = model.quats.detach().cpu().double().norm(dim=1).numpy()
    shapes = {
        "size": scales.mean(axis=1),
        "flatness": ordered[:, 1] - ordered[:, 0],
        "elongation": ordered[:, 2] - ordered[:, 1],
        "length of quaternions": np.log(np.maximum(lengths, 1e-9)),
    }
    for band in range(1, model.sh_degree + 1):
        part = model.sh[:, band**2 : (band + 1) ** 2].detach().cpu().double()
        shapes[f"harmonics of degree {band}"] = part.square().sum((1, 2)).clamp_min(1e-24).log().numpy()
    return shapes


DETECTORS = (invariants, opacities, order, colours)
