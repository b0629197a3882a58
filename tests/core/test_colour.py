"""Opponent colours."""

from __future__ import annotations

import numpy as np

from keyss.core import OPPONENT


def test_it_is_orthonormal_and_greys_have_no_differences() -> None:
    assert OPPONENT.dtype == np.float64
    np.testing.assert_allclose(OPPONENT @ OPPONENT.T, np.eye(3), atol=1e-15)
    greys = np.linspace(-2, 2, 9)[:, None] * np.ones(3)
    apart = greys @ OPPONENT.T
    np.testing.assert_allclose(apart[:, 0], np.sqrt(3) * greys[:, 0])
    np.testing.assert_allclose(apart[:, 1:], 0, atol=1e-15)
    np.testing.assert_allclose(apart @ OPPONENT, greys, atol=1e-15)
