"""A file against control models: weak ones are unusual, plain ones are not; candidate scores."""

from __future__ import annotations

import numpy as np
import pytest

from keyss.core import UsageError
from keyss.lab import changed_low_bits, judge
from keyss.lab.stealth.statistic import portion
from lab.stealth.candidates import candidate_scores, confirmation_p
from lab.stealth.careless import banded, overwritten, plain, plain_rounded
from methods.carry.carried import embed

LIMIT = 0.01


def test_plain_model_passes() -> None:
    controls = [plain(seed) for seed in range(3)]
    found = judge(plain(9), controls)
    assert found.least > LIMIT
    assert found.least_of_controls > LIMIT
    assert confirmation_p(plain(9), controls, plain(20, 800)) > LIMIT
    assert (found.invisible_groups, found.changed_low_bits) == (0, 0)


def test_new_bits_after_a_rounding_trainer() -> None:
    cover = plain_rounded(9)
    found = judge(overwritten(cover), [plain_rounded(seed) for seed in range(3)], original=cover)
    assert found.least < 1e-6
    assert found.statistics[0].name.startswith("bits: ")
    assert found.changed_low_bits == 1


def test_secret_in_a_band() -> None:
    secret, controls = plain(20, 800), [plain(seed) for seed in range(4)]
    file = banded(plain(9), secret)
    found = judge(file, controls)
    assert found.least < 1e-6
    assert found.invisible_groups == 1
    assert confirmation_p(file, controls, secret) < LIMIT


def test_fewer_than_two_controls() -> None:
    with pytest.raises(UsageError, match="at least two"):
        judge(plain(1), [plain(2)])


SECRETS = 2


def test_identical_high_bits() -> None:
    file = overwritten(plain(1))
    assert candidate_scores(file, plain(1))["identical high bits"] == 1
    assert candidate_scores(file, plain(2))["identical high bits"] == 0
    assert changed_low_bits(file, plain(1)) == 1
    assert changed_low_bits(file, plain(2)) == changed_low_bits(file, file) == 0


def test_carried_secrets_are_not_confirmed() -> None:
    """Embedding does not change the scores of candidates."""
    candidates = [plain(10 + index, 700) for index in range(SECRETS)]
    covers = [plain(index) for index in range(SECRETS)]
    before = [
        candidate_scores(cover, candidate)["nearness of rows, median"]
        for cover in covers
        for candidate in candidates
    ]
    files = [embed(cover, [("a key", secret)]) for cover, secret in zip(covers, candidates, strict=True)]
    after = [
        candidate_scores(file, candidate)["nearness of rows, median"]
        for file in files
        for candidate in candidates
    ]
    assert after == pytest.approx(before, abs=1e-2)


def test_numbers_that_change_together_count_once() -> None:
    copied = np.repeat([1, 0], [40, 960])
    alone, together = portion(copied), portion(59 * copied, 59)
    assert (together.value, together.error) == pytest.approx((alone.value, alone.error))
    assert alone.error == pytest.approx((0.04 * 0.96 / 1000) ** 0.5)
    assert portion(np.zeros(1000), 59).error == pytest.approx(1 / 59_000)
