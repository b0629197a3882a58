"""Trees that learn from other models predict bits where training shows in them, and no others."""

from __future__ import annotations

import pytest

from measure.stealth.careless import grey, overwritten, plain, plain_rounded
from stealth_predictor import BitPredictor

RANDOM_NOISE = 4.5  # standard errors


@pytest.fixture(scope="module")
def predictor() -> BitPredictor:
    return BitPredictor.fit([grey(plain_rounded(seed)) for seed in range(6)])


def _z(found: object) -> float:
    value, error = found.value, found.error  # type: ignore[attr-defined]
    return float(value / error)


def test_bits_of_a_trainer_that_rounds_are_predicted_until_they_are_replaced(predictor: BitPredictor) -> None:
    model = plain_rounded(20)
    name = "agreement without a like"
    assert _z(predictor.statistics(model)[name]) > 8
    assert abs(_z(predictor.statistics(overwritten(model, bits=12))[name])) < RANDOM_NOISE


def test_near_channels_predict_each_other(predictor: BitPredictor) -> None:
    name = "agreement beside its equal"
    assert predictor.statistics(grey(plain_rounded(21)))[name].value > 0.8
    assert name not in predictor.statistics(plain(21))


def test_random_bits_are_not_predicted(predictor: BitPredictor) -> None:
    """The exact null: whatever trees say, bits of `plain` are fair and independent."""
    for name, each in predictor.statistics(plain(22)).items():
        if each.error is not None:
            assert abs(_z(each)) < RANDOM_NOISE, name
