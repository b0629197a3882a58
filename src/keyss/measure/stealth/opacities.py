"""The distribution of opacities, which hiding Gaussians too faint to be rendered changes."""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.statistic import Floats, Statistic, Words, doubles, portion

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
_MIN_GAUSSIANS = 30  # of a mode
_DIP = 0.5  # of the lower of two modes: the density must fall to this between them


def opacities(model: Gaussians, words: Words) -> dict[str, Statistic]:
    """Shares by opacity, and differences between faint Gaussians and the others."""
    logits = doubles(model.opacity_logits)
    statistics = {
        f"share of opacities, {name}": portion(float(((logits >= low) & (logits < high)).sum()), len(logits))
        for name, (low, high) in _SHARES.items()
    }
    statistics["modes of faint opacities"] = Statistic(float(len(_modes(logits[logits < _FAINT]))))
    faint = logits < _FAINT
    for name, values in _shapes(model).items():
        few = min(faint.sum(), (~faint).sum()) < _MIN_GAUSSIANS
        parted = np.nan if few else float(np.median(values[faint]) - np.median(values[~faint]))
        statistics[f"faint against opaque, {name}"] = Statistic(parted)
        statistics[f"median {name}"] = Statistic(float(np.median(values)))
        statistics[f"spread of {name}"] = Statistic(float(np.subtract(*np.quantile(values, (0.9, 0.1)))))
    return statistics


def invisible_modes(model: Gaussians) -> list[float]:
    """Peaks of the density of opacity logits too low to be rendered: one for each group hidden there."""
    logits = doubles(model.opacity_logits)
    return _modes(logits[logits < INVISIBLE])


def _modes(logits: Floats) -> list[float]:
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


def _shapes(model: Gaussians) -> dict[str, Floats]:
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
