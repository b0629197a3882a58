"""A file against control models: careless ones are unusual, plain ones are not. Trees predict bits."""

from __future__ import annotations

import pytest

from keyss.core import UsageError
from keyss.lab import judge
from lab.stealth.careless import banded, grey, normalised, overwritten, plain, plain_rounded
from lab.stealth.predictor import BitPredictor

LIMIT = 0.01


def test_a_plain_model_is_usual() -> None:
    found = judge(plain(9), [plain(seed) for seed in range(3)], candidates=[plain(20, 800), None])
    assert found.least > LIMIT
    assert found.least_of_controls > LIMIT
    assert found.least_confirmation > LIMIT
    assert found.confirmations[1] is None
    assert (found.invisible_groups, found.changed_low_bits) == (0, 0)


def test_new_bits_of_a_rounding_trainer_are_unusual() -> None:
    cover = plain_rounded(9)
    found = judge(overwritten(cover), [plain_rounded(seed) for seed in range(3)], original=cover)
    assert found.least < 1e-6
    assert found.statistics[0].name.startswith("bits: ")
    assert found.changed_low_bits == 1


def test_broken_unit_quaternions_are_unusual() -> None:
    found = judge(overwritten(normalised(plain(9))), [normalised(plain(seed)) for seed in range(3)])
    assert found.least < 1e-6
    assert "unit" in found.statistics[0].name


def test_secrets_in_a_band_are_unusual_counted_and_confirmed() -> None:
    secret = plain(20, 800)
    found = judge(banded(plain(9), secret), [plain(seed) for seed in range(4)], candidates=[secret])
    assert found.least < 1e-6
    assert found.invisible_groups == 1
    assert found.least_confirmation < LIMIT


def test_it_takes_two_controls() -> None:
    with pytest.raises(UsageError, match="at least two"):
        judge(plain(1), [plain(2)])


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
