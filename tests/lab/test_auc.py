"""AUCs against pairs counted one by one; an interval by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import expit, logit

from keyss.core import UsageError
from keyss.lab import auc_between

SCORES = st.lists(st.sampled_from([math.nan, -0.5, 0.0, 0.1, 0.2, 0.7, 1e300]), min_size=1, max_size=9)


@given(SCORES, SCORES)
@settings(deadline=None)
def test_auc_is_the_share_of_ordered_pairs(negatives: list[float], positives: list[float]) -> None:
    def number(score: float) -> float:
        return -math.inf if math.isnan(score) else score

    pairs = [(number(n), number(p)) for n in negatives for p in positives]
    counted = sum((n < p) + 0.5 * (n == p) for n, p in pairs) / len(pairs)
    found = auc_between(negatives, positives)
    assert found.auc == pytest.approx(counted, abs=1e-12)
    assert 0 <= found.low <= found.auc + 1e-12
    assert found.auc - 1e-12 <= found.high <= 1


def test_delong_interval_by_hand() -> None:
    found = auc_between([1, 2, 3], [2, 3, 4])
    components = [1 / 2, 5 / 6, 1]  # of 2, 3, 4 against the others; those of 3, 2, 1 are the same
    variance = 2 * np.var(components, ddof=1) / 3
    spread = 1.959964 * math.sqrt(variance) / (7 / 9 * 2 / 9)
    assert found.auc == pytest.approx(7 / 9)
    assert found.low == pytest.approx(expit(logit(7 / 9) - spread), abs=1e-6)
    assert found.high == pytest.approx(expit(logit(7 / 9) + spread), abs=1e-6)


@pytest.mark.parametrize(("negatives", "positives"), [([], [1.0]), ([1.0], []), ([], [])])
def test_empty_class(negatives: list[float], positives: list[float]) -> None:
    with pytest.raises(UsageError, match="both classes"):
        auc_between(negatives, positives)
