"""Noise in green and blue compared with red, which the channel of colours does not write.

Neighbours in space and rows, often one Gaussian before density control, differ about equally in all three
channels. Noise in two of them shows first in the pairs that differ least, and most in small and faint
Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.statistic import Floats, Ints, Statistic, Words, doubles

_QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.9)
_CHANNELS = {"green": 1, "blue": 2}
_PARTS = ("most visible", "more visible", "less visible", "least visible")
_MIN_PAIRS = 200
_TINY = 1e-4  # of a colour: smaller differences count as none


def colours(model: Gaussians, words: Words) -> dict[str, Statistic]:
    """Logarithms of ratios of differences; 0 if green or blue vary as red does."""
    values = np.nan_to_num(doubles(model.sh[:, 0]))
    statistics: dict[str, Statistic] = {}
    if len(values) < _MIN_PAIRS:
        return statistics
    positions = np.nan_to_num(doubles(model.means))
    _, near = cKDTree(positions).query(positions, k=2)
    rows = np.arange(len(values))
    pairs = {"neighbours": np.stack([rows, near[:, 1]], axis=1), "rows": np.stack([rows[1:], rows[:-1]], 1)}
    for name, pair in pairs.items():
        apart = np.abs(values[pair[:, 0]] - values[pair[:, 1]])
        for channel, index in _CHANNELS.items():
            for quantile in _QUANTILES:
                ratio = _ratio(apart[:, index], apart[:, 0], quantile)
                statistics[f"{channel} of {name}, {quantile}"] = ratio
            close = apart[apart[:, 0] <= np.quantile(apart[:, 0], 0.1)]
            ratio = _ratio(close[:, index], apart[:, index], 0.5)
            statistics[f"{channel} of {name} with the same red"] = ratio
    for name, part in _parts(model):
        apart = np.abs(values[part] - values[near[part, 1]])
        for channel, index in _CHANNELS.items():
            statistics[f"{channel} of neighbours, {name}"] = _ratio(apart[:, index], apart[:, 0], 0.25)
    inside = {f"{one} and {other}": np.abs(values[:, i] - values[:, j]) for one, other, i, j in _BETWEEN}
    usual = np.median(np.stack(list(inside.values())), axis=1).mean()
    for name, each in inside.items():
        for quantile in _QUANTILES[:2]:
            statistics[f"{name}, {quantile}"] = Statistic(
                float(np.log((np.quantile(each, quantile) + _TINY) / (usual + _TINY)))
            )
    return statistics


_BETWEEN = (("red", "green", 0, 1), ("red", "blue", 0, 2), ("green", "blue", 1, 2))


def _parts(model: Gaussians) -> Iterator[tuple[str, Ints]]:
    """Quarters of the rows by the visibility of a colour change: area times squared opacity."""
    scales = model.log_scales.detach().cpu().double().sort(dim=1).values[:, 1:].sum(dim=1)
    shown = (scales + 2 * model.opacities.detach().cpu().double().clamp_min(1e-6).log()).numpy()
    yield from zip(_PARTS, np.array_split(np.argsort(-np.nan_to_num(shown), kind="stable"), 4), strict=True)


def _ratio(one: Floats, other: Floats, quantile: float) -> Statistic:
    first, second = np.quantile(one, quantile), np.quantile(other, quantile)
    return Statistic(float(np.log((first + _TINY) / (second + _TINY))))
