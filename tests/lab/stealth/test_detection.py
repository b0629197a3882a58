"""Detectors are tried on scenes that they did not learn from, and know what chance makes of many tries."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from keyss.lab import stealth_statistics
from lab.stealth.careless import overwritten, plain_rounded
from lab.stealth.detectors import Examples, areas, learned_detectors, single_detectors

SCENES = 4


def _examples(shift: float, seed: int = 0, models: int = 24, statistics: int = 60) -> Examples:
    """Random statistics, the first one higher by `shift` where something is hidden."""
    random = np.random.default_rng(seed)
    values = random.normal(size=(2 * models, statistics))
    hidden = np.tile([0, 1], models)
    values[:, 0] += shift * hidden
    rows = [dict(zip(map(str, range(statistics)), row, strict=True)) for row in values]
    model = [str(index // 2) for index in range(2 * models)]
    return Examples.of(rows, hidden.tolist(), [str(int(each) % SCENES) for each in model], model)


def test_the_area_is_that_of_scikit_learn() -> None:
    random = np.random.default_rng(0)
    hidden, scores = random.integers(0, 2, 200), random.integers(0, 20, 200).astype(float)
    scene = np.arange(200) % 2
    expected = [roc_auc_score(hidden[scene == each], scores[scene == each]) for each in (0, 1)]
    assert areas(scores[:, None], hidden, scene) == pytest.approx(np.mean(expected))


def test_a_statistic_that_tells_is_found() -> None:
    found, chance = single_detectors(_examples(3.0))
    assert found[0].name == "0"
    assert found[0].auc > 0.95 > chance
    assert all(each.auc > 0.85 for each in learned_detectors(_examples(5.0)))


def test_the_best_of_many_random_ones_is_no_better_than_chance() -> None:
    found, chance = single_detectors(_examples(0.0, seed=3))
    assert 0.6 < found[0].auc <= chance + 0.05
    assert all(abs(each.auc - 0.5) < 0.25 for each in learned_detectors(_examples(0.0, seed=3)))


def test_detectors_of_nothing_come_out_at_a_half() -> None:
    """Not below, as when scores of scenes that learned from each other are compared."""
    found = [each.auc for seed in range(12) for each in learned_detectors(_examples(0.0, seed, statistics=5))]
    assert np.mean(found) == pytest.approx(0.5, abs=0.06)


def test_a_direction_that_holds_in_one_scene_only_does_not_count() -> None:
    examples = _examples(0.0, models=40, statistics=8)
    odd = examples.scene == 0
    examples.values[odd, 1] += 9.0 * examples.hidden[odd]
    found, _ = single_detectors(examples)
    assert next(each.auc for each in found if each.name == "1") < 0.75


def test_careless_embedding_is_told_where_bits_were_not_random() -> None:
    """By one statistic in every pair: its means, 0.38 and 0.50, are 15 standard deviations apart.

    If nothing told them, the best of 250 statistics would be right in all pairs once in 600 times.
    """
    rows, hidden, scenes, models = [], [], [], []
    for seed in range(12):
        model = plain_rounded(seed)
        for kind, file in enumerate((model, overwritten(model, seed))):
            rows.append({name: each.value for name, each in stealth_statistics(file).items()})
            hidden.append(kind)
            scenes.append(str(seed % SCENES))
            models.append(str(seed))
    found, _ = single_detectors(Examples.of(rows, hidden, scenes, models))
    assert found[0].auc == 1
