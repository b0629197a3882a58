"""The classifier separates different models, not equal ones, and its interval is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from keyss.core import Gaussians, UsageError
from keyss.lab import Auc, features, two_sample_auc
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


def test_auc_of_a_model_against_itself() -> None:
    assert two_sample_auc(MODEL, MODEL) == Auc(0.5, 0.5, 0.5)


def test_auc_of_independent_samples() -> None:
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
def test_changed_models_are_separated(change: Callable[[Gaussians], Gaussians], least: float) -> None:
    assert two_sample_auc(MODEL, change(OTHER)).low > least


def test_features_ignore_quaternion_sign_and_axis_order() -> None:
    """Negated quaternions; axes in another order, which a turn by 90 degrees about one of them makes good."""
    w, x, y, z = MODEL.quats.unbind(1)
    turned = torch.stack([w - z, x + y, y - x, w + z], dim=1)  # q (1, 0, 0, 1): x and y change places
    reordered = replace(MODEL, quats=turned, log_scales=MODEL.log_scales[:, [1, 0, 2]])
    for other in (replace(MODEL, quats=-MODEL.quats), reordered):
        for name, values in features(other).items():
            np.testing.assert_allclose(values, features(MODEL)[name], atol=1e-5, err_msg=name)


def test_too_little_is_refused() -> None:
    with pytest.raises(UsageError, match="empty"):
        features(MODEL[:0])
    with pytest.raises(UsageError, match="at least 100"):
        two_sample_auc(MODEL, MODEL[:99])
    with pytest.raises(UsageError, match="too few places"):
        two_sample_auc(MODEL, replace(MODEL, means=0 * MODEL.means + torch.arange(800)[:, None] // 400))
