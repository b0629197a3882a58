"""The classifier separates different models, not equal ones, and its interval is right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.metrics import roc_auc_score

from keyss.core import Gaussians, UsageError
from keyss.lab import Auc, auc_beside_controls, delong, features, two_sample_auc
from lab.lifelike import (
    doubled_scales,
    lifelike,
    random_rotations,
    red_for_blue,
    rescaled_quaternions,
    stronger_harmonics,
    tripled_positions,
)

MODEL = lifelike(800).with_sh_degree(1)
OTHER = lifelike(800, seed=1).with_sh_degree(1)


def test_a_model_cannot_be_told_from_itself() -> None:
    assert two_sample_auc(MODEL, MODEL) == Auc(0.5, 0.5, 0.5)


def test_nor_from_itself_shuffled_and_hardly_changed() -> None:
    """The equal of each Gaussian has the other label; trees that learn from it answer the wrong way."""
    order = torch.randperm(800, generator=torch.Generator().manual_seed(0))
    near_equal = MODEL.map(lambda values: values[order] * (1 + 1e-6))
    assert two_sample_auc(MODEL, near_equal).auc == pytest.approx(0.5, abs=0.02)


def test_nor_from_independent_samples_of_the_same_and_it_is_not_sure() -> None:
    found = two_sample_auc(MODEL, rescaled_quaternions(OTHER))
    width = found.high - found.low
    assert found.auc == pytest.approx(0.5, abs=0.75 * width)  # 3 standard errors, for any random draw
    assert width == pytest.approx(2 * 1.96 * (2 / (12 * 800)) ** 0.5, rel=0.1)


@pytest.mark.parametrize(
    ("change", "least"),
    [
        (doubled_scales, 0.55),
        (random_rotations, 0.55),
        (tripled_positions, 0.9),
        (red_for_blue, 0.9),
        (stronger_harmonics, 0.99),
    ],
)
def test_what_differs_is_told_apart(change: Callable[[Gaussians], Gaussians], least: float) -> None:
    assert two_sample_auc(MODEL, change(OTHER)).low > least


def test_nearly_as_well_as_can_be() -> None:
    """Normal numbers one standard deviation apart: no classifier gets beyond 0.760."""
    shifted = lifelike(2000, seed=1).with_sh_degree(0)
    shifted = replace(shifted, opacity_logits=shifted.opacity_logits + 1.5)
    auc = two_sample_auc(lifelike(2000).with_sh_degree(0), shifted).auc
    assert 0.72 < auc < 0.78


def test_sizes_may_differ_and_only_the_seed_decides() -> None:
    runs = [two_sample_auc(MODEL, doubled_scales(OTHER[:300]), seed=seed) for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]


def test_delong_is_what_it_is_defined_as() -> None:
    generator = np.random.default_rng(0)
    negatives = generator.standard_normal(40).round(1)
    positives = (0.7 + generator.standard_normal(60)).round(1)  # rounded, so that there are ties
    wins = (positives[:, None] > negatives) + 0.5 * (positives[:, None] == negatives)
    variance = wins.mean(axis=1).var(ddof=1) / 60 + wins.mean(axis=0).var(ddof=1) / 40
    expected = roc_auc_score(np.repeat([0, 1], [40, 60]), np.concatenate([negatives, positives]))
    assert delong(negatives, positives) == pytest.approx((expected, variance), rel=1e-12)


def test_against_plain_models() -> None:
    plain = [lifelike(300, seed).with_sh_degree(0) for seed in (1, 2)]
    model = tripled_positions(lifelike(300).with_sh_degree(0))
    found = auc_beside_controls(model, plain, plain[0])
    assert len(found.stego) == 2
    assert found.stego[1] == two_sample_auc(plain[1], model)
    assert found.control == (two_sample_auc(*plain),)
    assert found.original == (two_sample_auc(plain[0], plain[0]), two_sample_auc(plain[1], plain[0]))
    assert min(each.auc for each in found.stego) > 0.85 > 0.6 > found.control[0].auc


def test_another_way_to_write_the_same_gaussians_has_the_same_features() -> None:
    """Negated quaternions; axes in another order, which a turn by 90 degrees about one of them makes good."""
    w, x, y, z = MODEL.quats.unbind(1)
    turned = torch.stack([w - z, x + y, y - x, w + z], dim=1)  # q (1, 0, 0, 1): x and y change places
    reordered = replace(MODEL, quats=turned, log_scales=MODEL.log_scales[:, [1, 0, 2]])
    for other in (replace(MODEL, quats=-MODEL.quats), reordered):
        for name, values in features(other).items():
            np.testing.assert_allclose(values, features(MODEL)[name], atol=1e-5, err_msg=name)


def test_round_gaussians_have_no_rotation() -> None:
    ball = replace(MODEL, log_scales=MODEL.log_scales[:, :1].expand(-1, 3))
    assert not features(random_rotations(ball))["rotation"].any()


def test_values_that_are_not_finite_give_finite_features() -> None:
    logits = MODEL.opacity_logits.clone()
    logits[:3] = torch.tensor([math.nan, math.inf, -math.inf])
    found = features(replace(MODEL, opacity_logits=logits, quats=0 * MODEL.quats))
    assert all(np.isfinite(values).all() for values in found.values())
    assert found["opacity"][:3, 0].tolist() == [-16, 16, -16]


def test_too_little_is_refused() -> None:
    with pytest.raises(UsageError, match="empty"):
        features(MODEL[:0])
    with pytest.raises(UsageError, match="two control models"):
        auc_beside_controls(MODEL, [OTHER], MODEL)
    with pytest.raises(UsageError, match="at least 100"):
        two_sample_auc(MODEL, MODEL[:99])
    with pytest.raises(UsageError, match="too few places"):
        two_sample_auc(MODEL, replace(MODEL, means=0 * MODEL.means + torch.arange(800)[:, None] // 400))
