"""The order of rows: its correlation with their content, and relations of adjacent rows."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp, rankdata

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.statistic import Floats, Statistic, Words, doubles, normal, portion

_KS_SPREAD = 0.2603  # standard deviation of Kolmogorov's distribution
_NEAR = 1e-5  # of the model's size


def order(model: Gaussians, words: Words) -> dict[str, Statistic]:
    """Correlations of the content of rows with their number, and halves against each other; null: any order.

    Plain models have an order too, given by density control: compared with controls, a shuffled file is as
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
    pairs = len(cKDTree(positions).query_pairs(_NEAR * size, output_type="ndarray"))
    statistics["near duplicates"] = portion(pairs, count)
    return statistics


def _columns(model: Gaussians) -> dict[str, Floats]:
    """[N] the content of each Gaussian by name."""
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
