"""Noise in green and blue relative to red, which the channel `colours` does not change, and opacities.

Neighbours in space and in rows, often one Gaussian before density control, differ about equally in all three
colours. Noise in two of them is most noticeable in pairs that differ least, and in small and faint Gaussians.
Hiding Gaussians too faint to render changes the distribution of opacities.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import find_peaks

from keyss.core.arrays import Doubles, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.lab.stealth.statistic import BitPatterns, Statistic, portion

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
_MIN_GAUSSIANS = 30  # minimum Gaussians per mode
_DIP = 0.5  # two modes are separate if the density between them falls to this fraction of the lower one


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
    for name, part in _parts(model):
        distance = np.abs(values[part] - values[near[part, 1]])
        for channel, index in _CHANNELS.items():
            statistics[f"{channel} of neighbours, {name}"] = _ratio(distance[:, index], distance[:, 0], 0.25)
    inside = {f"{one} and {other}": np.abs(values[:, i] - values[:, j]) for one, other, i, j in _BETWEEN}
    usual = np.median(np.stack(list(inside.values())), axis=1).mean()
    for name, each in inside.items():
        for quantile in _QUANTILES[:2]:
            statistics[f"{name}, {quantile}"] = Statistic(
                float(np.log((np.quantile(each, quantile) + _TINY) / (usual + _TINY)))
            )
    return statistics


_BETWEEN = (("red", "green", 0, 1), ("red", "blue", 0, 2), ("green", "blue", 1, 2))


def _parts(model: Gaussians) -> Iterator[tuple[str, Integers]]:
    """Quarters of the rows by the visibility of a colour change: area times squared opacity."""
    scales = model.log_scales.detach().cpu().double().sort(dim=1).values[:, 1:].sum(dim=1)
    shown = (scales + 2 * model.opacities.detach().cpu().double().clamp_min(1e-6).log()).numpy()
    yield from zip(_PARTS, np.array_split(np.argsort(-np.nan_to_num(shown), kind="stable"), 4), strict=True)


def _ratio(one: Doubles, other: Doubles, quantile: float) -> Statistic:
    first, second = np.quantile(one, quantile), np.quantile(other, quantile)
    return Statistic(float(np.log((first + _TINY) / (second + _TINY))))


def opacities(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Shares of ranges of opacity, and differences between faint and other Gaussians."""
    logits = doubles(model.opacity_logits)
    statistics = {
        f"share of opacities, {name}": portion(float(((logits >= low) & (logits < high)).sum()), len(logits))
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
