"""The distribution of opacities, which hiding below the threshold of drawing changes."""

from __future__ import annotations

import numpy as np

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.statistic import Statistic, portion
from keyss.measure.stealth.words import Floats, doubles

UNDRAWN = -5.6  # logits below are never drawn
_SHARES = {
    "logit below -12": (-np.inf, -12.0),
    "logit -12 to -8": (-12.0, -8.0),
    "never drawn": (-np.inf, UNDRAWN),
    "drawn, below 0.005": (-5.54, -5.293),
    "0.005 to 0.05": (-5.293, -2.944),
    "0.05 to 0.5": (-2.944, 0.0),
    "0.5 to 0.9": (0.0, 2.197),
    "above 0.99": (4.595, np.inf),
}
_FAINT = -2.944
_BANDWIDTH, _STEP = 0.15, 0.05  # logits
_MIN_GAUSSIANS = 30  # of a mode
_DIP = 0.5  # of the lower of two modes: how far the density must fall between them


def opacities(model: Gaussians) -> dict[str, Statistic]:
    """Shares by opacity, and how faint Gaussians differ from the others."""
    logits = doubles(model.opacity_logits)
    found = {
        f"share of opacities, {name}": portion(float(((logits >= low) & (logits < high)).sum()), len(logits))
        for name, (low, high) in _SHARES.items()
    }
    found["modes of faint opacities"] = Statistic(float(len(modes(logits[logits < _FAINT]))))
    faint = logits < _FAINT
    for name, values in _shapes(model).items():
        few = min(faint.sum(), (~faint).sum()) < _MIN_GAUSSIANS
        parted = np.nan if few else float(np.median(values[faint]) - np.median(values[~faint]))
        found[f"faint against opaque, {name}"] = Statistic(parted)
        found[f"median {name}"] = Statistic(float(np.median(values)))
        found[f"spread of {name}"] = Statistic(float(np.subtract(*np.quantile(values, (0.9, 0.1)))))
    return found


def modes(logits: Floats) -> list[float]:
    """Separate peaks of the density of opacity logits [N]: one for each group hidden there."""
    if len(logits) < _MIN_GAUSSIANS:
        return []
    low, high = logits.min() - 1, logits.max() + 1
    edges = np.arange(low, high + _STEP, _STEP)
    counts = np.histogram(logits, edges)[0].astype(float)
    reach = int(4 * _BANDWIDTH / _STEP)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * _STEP / _BANDWIDTH) ** 2)
    density = np.convolve(counts, kernel, mode="same")
    found: list[int] = []
    lowest = 0.0  # since the last mode
    for at in range(1, len(density) - 1):
        lowest = min(lowest, density[at])
        if not (
            density[at] >= density[at - 1]
            and density[at] > density[at + 1]
            and density[at] >= _MIN_GAUSSIANS / 2
        ):
            continue
        if found and lowest > _DIP * min(density[found[-1]], density[at]):
            if density[at] > density[found[-1]]:
                found[-1] = at
        else:
            found.append(at)
        lowest = density[at]
    return [float(edges[at] + _STEP / 2) for at in found]


def _shapes(model: Gaussians) -> dict[str, Floats]:
    scales = doubles(model.log_scales)
    ordered = np.sort(scales, axis=1)
    lengths = model.quats.detach().cpu().double().norm(dim=1).numpy()
    found = {
        "size": scales.mean(axis=1),
        "flatness": ordered[:, 1] - ordered[:, 0],
        "elongation": ordered[:, 2] - ordered[:, 1],
        "length of quaternions": np.log(np.maximum(lengths, 1e-9)),
    }
    for band in range(1, model.sh_degree + 1):
        part = model.sh[:, band**2 : (band + 1) ** 2].detach().cpu().double()
        found[f"harmonics of degree {band}"] = part.square().sum((1, 2)).clamp_min(1e-24).log().numpy()
    return found
