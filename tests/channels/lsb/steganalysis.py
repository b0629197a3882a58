"""What an attacker can count in the low bits of a model, and how well that tells embedded models."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from keyss.core import Gaussians

WIDTH = 16  # mantissa bits looked at: those in use, and some above them
Numbers = npt.NDArray[np.float64]


def features(gaussians: Gaussians) -> Numbers:
    """[F] statistics per group of properties: bit frequencies, runs, pairs, bytes, zeros, repetitions."""
    rest = gaussians.sh[:, 1:]
    groups = [
        gaussians.means,
        gaussians.log_scales,
        gaussians.quats,
        gaussians.opacity_logits[:, None],
        *(rest[:, start:end].flatten(1) for start, end in ((0, 3), (3, 8), (8, 15))),
    ]
    return np.concatenate([_of_group(group.contiguous().numpy()) for group in groups if group.shape[1]])


def _of_group(values: npt.NDArray[np.float32]) -> Numbers:
    words = values.view(np.uint32)
    used = words[(words & 0xFFFFF) != 0]  # without zeros and short numbers, which embedding leaves alone
    bits = (used[:, None] >> np.arange(WIDTH)) & 1
    count = max(len(used), 1)
    scale = np.sqrt(count)
    frequencies = (bits.mean(0) - 0.5) * scale
    flips = ((bits[:, 1:] ^ bits[:, :-1]).mean(0) - 0.5) * scale
    runs = np.array([(bits[:, 1:] ^ bits[:, :-1]).sum(1).var()])
    between = (words[:, 1:] ^ words[:, :-1]) if words.shape[1] > 1 else words[1:] ^ words[:-1]
    pairs = (((between.reshape(-1, 1) >> np.arange(12)) & 1).mean(0) - 0.5) * scale
    bytes_ = np.array([_chi_square(used >> shift & 255, 256) for shift in (0, 4, 8)])
    pairs_of_values = np.array([_pairs_of_values(used & 255)])
    low_zero = np.array([((used & 0xFFF) == 0).mean() * 4096, ((used & 0xFF) == 0).mean() * 256])
    same = np.array([1 - len(np.unique(used)) / count, 1 - len(np.unique(used & 0xFFF)) / min(count, 4096)])
    return np.concatenate([frequencies, flips, runs, pairs, bytes_, pairs_of_values, low_zero, same])


def _chi_square(numbers: npt.NDArray[np.uint32], bins: int) -> float:
    counts = np.bincount(numbers, minlength=bins)
    expected = max(len(numbers), 1) / bins
    return float(((counts - expected) ** 2).sum() / expected / (bins - 1))


def _pairs_of_values(numbers: npt.NDArray[np.uint32]) -> float:
    """Westfeld and Pfitzmann's attack: frequencies of values that differ in the last bit only."""
    counts = np.bincount(numbers, minlength=256).reshape(-1, 2).astype(float)
    expected = counts.mean(1).clip(0.5)
    return float((((counts[:, 0] - expected) ** 2) / expected).mean())


def held_out_auc(
    x: Numbers, y: npt.NDArray[np.int64], groups: npt.NDArray[np.int64], trees: int = 300
) -> dict[str, float]:
    """AUC of two classifiers on groups (scenes) that they were not trained on."""
    result = {}
    for name, make in (
        ("logistic", lambda: make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=2000))),
        ("forest", lambda: RandomForestClassifier(trees, min_samples_leaf=2, random_state=0)),
    ):
        scores = np.zeros(len(y))  # probabilities of being embedded
        for group in np.unique(groups):
            test = groups == group
            scores[test] = make().fit(x[~test], y[~test]).predict_proba(x[test])[:, 1]
        result[name] = float(roc_auc_score(y, scores))
    return result
