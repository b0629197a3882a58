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


def parts(gaussians: Gaussians, depth: int) -> list[Gaussians]:
    """2^depth spatially disjoint parts of equal size, cut at medians along the longest axis."""
    if depth == 0:
        return [gaussians]
    axis = int((gaussians.means.quantile(0.9, 0) - gaussians.means.quantile(0.1, 0)).argmax())
    order = gaussians.means[:, axis].argsort()
    half = len(order) // 2
    return parts(gaussians[order[:half]], depth - 1) + parts(gaussians[order[half:]], depth - 1)


def held_out_auc(
    x: Numbers, y: npt.NDArray[np.int64], groups: npt.NDArray[np.int64], trees: int = 300
) -> dict[str, float]:
    """AUC of two classifiers on groups (scenes) that they were not trained on."""
    found = held_out_scores(x, y, groups, trees)
    return {name: float(roc_auc_score(y, scores)) for name, scores in found.items()}


def held_out_scores(
    x: Numbers, y: npt.NDArray[np.int64], groups: npt.NDArray[np.int64], trees: int = 300
) -> dict[str, Numbers]:
    """[N] probabilities of being embedded, from two classifiers trained on the other groups."""
    result = {}
    for name, make in (
        ("logistic", lambda: make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=2000))),
        ("forest", lambda: RandomForestClassifier(trees, min_samples_leaf=2, random_state=0)),
    ):
        scores = np.zeros(len(y))
        for group in np.unique(groups):
            test = groups == group
            scores[test] = make().fit(x[~test], y[~test]).predict_proba(x[test])[:, 1]
        result[name] = scores
    return result


def standard_error(
    scores: Numbers, y: npt.NDArray[np.int64], models: npt.NDArray[np.int64], draws: int = 1000
) -> float:
    """Of the AUC: whole models are drawn again (bootstrap), for parts of one are not independent."""
    random = np.random.default_rng(0)
    rows = [np.flatnonzero(models == model) for model in np.unique(models)]
    aucs = []
    while len(aucs) < draws:
        drawn = np.concatenate([rows[model] for model in random.integers(len(rows), size=len(rows))])
        if 0 < y[drawn].sum() < len(drawn):
            aucs.append(roc_auc_score(y[drawn], scores[drawn]))
    return float(np.std(aucs))
