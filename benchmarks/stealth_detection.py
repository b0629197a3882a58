"""Detectors of hidden content from statistics of files, cross-validated over scenes.

Standard errors are bootstrapped over models, because parts of a model are not independent. The largest of
many areas under curves is compared with those after exchanging labels within pairs (a permutation test).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from keyss.core.arrays import Doubles, Integers

import numpy as np

_DRAWS = 300  # bootstrap samples
_EXCHANGES = 100
_BEST = 12  # best statistics for logistic regression ...
_EXAMPLES = 16  # ... at most one per this many examples, against overfitting


@dataclass(frozen=True)
class Detection:
    """One detector: area under the ROC curve on held-out scenes."""

    name: str
    auc: float
    error: float  # standard error
    pooled: float  # area over the files of all scenes together, for a common threshold


@dataclass(frozen=True)
class Examples:
    """Files, or one part of each; those of one `model` differ only in hidden content."""

    names: tuple[str, ...]  # names of the statistics
    values: Doubles  # [E, S], NaN where there was too little to count
    hidden: Integers  # [E] 0 plain, 1 with something in it
    scene: Integers  # [E]
    model: Integers  # [E]

    @staticmethod
    def of(files: Iterable[tuple[Mapping[str, float], int, str, str]]) -> Examples:
        """Of statistics, 0 or 1 for something hidden, scene and model of each file."""
        rows, hidden, scenes, models = zip(*files, strict=True)
        names = tuple(dict.fromkeys(name for row in rows for name in row))
        values = np.array([[row.get(name, np.nan) for name in names] for row in rows], float)
        scene, model = (np.unique(each, return_inverse=True)[1] for each in (scenes, models))
        return Examples(names, values, np.array(hidden), scene, model)


def single_detectors(examples: Examples, count: int) -> tuple[list[Detection], float]:
    """The `count` best single statistics, and the 95 % quantile of the largest area under permutation.

    The sign and the normal range come from the other scenes.
    """
    scores_for = _held_out(examples)
    scores = scores_for(examples.hidden)
    found = areas(scores, examples.hidden, examples.scene)
    random = np.random.default_rng(0)
    largest = []
    for _ in range(_EXCHANGES):
        flip = random.integers(0, 2, examples.model.max() + 1)[examples.model]
        exchanged = examples.hidden ^ flip
        largest.append(areas(scores_for(exchanged), exchanged, examples.scene).max())
    worst = np.argsort(-found)[:count]
    named = _detections([examples.names[index] for index in worst], scores[:, worst], examples)
    return named, float(np.quantile(largest, 0.95))


def learned_detectors(examples: Examples) -> list[Detection]:
    """Logistic regression and boosted trees over all statistics."""
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import QuantileTransformer

    names, scores = ("logistic", "trees"), np.zeros((len(examples.hidden), 2))
    for column, name in enumerate(names):
        for scene in np.unique(examples.scene):
            held = examples.scene == scene
            others = examples.values[~held]
            parts = others, examples.values[held]
            train, test = (np.where(np.isnan(part), _usual(others), part) for part in parts)
            if name == "logistic":
                # Ranks, because some statistics have tails of many standard deviations.
                spread = QuantileTransformer(n_quantiles=min(len(train), 200), output_distribution="normal")
                above = _lean(_ranks(train), examples.hidden[~held])
                best = np.argsort(-np.abs(above))[: min(_BEST, 1 + len(train) // _EXAMPLES)]
                train, test = train[:, best], test[:, best]
                machine = make_pipeline(spread, LogisticRegression(C=0.1, max_iter=2000))
            else:
                machine = HistGradientBoostingClassifier(
                    max_iter=80, max_leaf_nodes=8, min_samples_leaf=5, learning_rate=0.1, random_state=0
                )
            scores[held, column] = machine.fit(train, examples.hidden[~held]).decision_function(test)
    return _detections([f"{name} over all" for name in names], scores, examples)


def _detections(names: Sequence[str], scores: Doubles, examples: Examples) -> list[Detection]:
    """A detection for each column of scores [E, S]."""
    own = areas(scores, examples.hidden, examples.scene)
    pooled = areas(scores, examples.hidden, np.zeros_like(examples.scene))
    columns = zip(names, own, _errors(scores, examples), pooled, strict=True)
    return [Detection(name, *map(float, numbers)) for name, *numbers in columns]


def areas(scores: Doubles, hidden: Integers, scene: Integers) -> Doubles:
    """[S] areas under the ROC curves of scores [E, S], ties counting half: means over scenes.

    Only files of one scene are compared. Pooling scenes that were trained on each other would put useless
    detectors below 0.5.
    """
    total, weights = np.zeros(scores.shape[1]), 0
    for each in np.unique(scene):
        held = scene == each
        own = hidden[held]
        positives = int(own.sum())
        negatives = len(own) - positives
        if positives and negatives:
            ranks = _ranks(scores[held])
            above = ranks[own == 1].sum(axis=0) - positives * (positives + 1) / 2
            total += len(own) * above / (positives * negatives)
            weights += len(own)
    found: Doubles = total / max(weights, 1)
    return found


def confirmed(scores: Doubles, true: Sequence[int]) -> float:
    """Probability that the true candidate ranks above another one, ties counting half; 0.5 is chance.

    `scores` [F, C] of files and candidates, `true` [F] the candidate in each file. Scores are relative to the
    candidate's in files that hold something else, then to the file's for other candidates.
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


def _ranks(values: Doubles) -> Doubles:
    from scipy.stats import rankdata

    ranks: Doubles = rankdata(values, axis=0)
    return ranks


def _held_out(examples: Examples) -> Callable[[Integers], Doubles]:
    """A function from labels [E] to scores [E, S], with the sign and the median of the other scenes."""
    centred, folds = np.empty_like(examples.values), []
    for scene in np.unique(examples.scene):
        held = examples.scene == scene
        usual = _usual(examples.values[~held])
        centred[held] = np.nan_to_num(examples.values[held] - usual)
        folds.append((held, _ranks(np.nan_to_num(examples.values[~held] - usual))))

    def scores(hidden: Integers) -> Doubles:
        signed = np.empty_like(centred)
        for held, ranks in folds:
            signed[held] = centred[held] * np.where(_lean(ranks, hidden[~held]) >= 0, 1, -1)
        return signed

    return scores


def _usual(values: Doubles) -> Doubles:
    """[S] medians of statistics [E, S], 0 for those that no file has."""
    medians: Doubles = np.nanmedian(np.where(np.isnan(values).all(axis=0), 0.0, values), axis=0)
    return medians


def _lean(ranks: Doubles, hidden: Integers) -> Doubles:
    """[S] difference in mean rank between files with and without hidden content."""
    found: Doubles = ranks[hidden == 1].mean(axis=0) - ranks[hidden == 0].mean(axis=0)
    return found


def _errors(scores: Doubles, examples: Examples) -> Doubles:
    """[S] standard errors of areas, bootstrapped over models within scenes."""
    random = np.random.default_rng(0)
    rows = [np.flatnonzero(examples.model == model) for model in np.unique(examples.model)]
    scenes = np.array([examples.scene[own[0]] for own in rows])
    strata = [np.flatnonzero(scenes == scene) for scene in np.unique(scenes)]
    found = []
    for _ in range(_DRAWS):
        chosen = np.concatenate([random.choice(own, len(own)) for own in strata])
        drawn = np.concatenate([rows[index] for index in chosen])
        found.append(areas(scores[drawn], examples.hidden[drawn], examples.scene[drawn]))
    errors: Doubles = np.std(found, axis=0)
    return errors
