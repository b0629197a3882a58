"""Changes that leave a model as likely as it was: what is usual between neighbours stays so."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from keyss.channels.colours.planner import Likelihood

NOISE = 0.0275
Doubles = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def model() -> tuple[Doubles, Doubles]:
    """Colours [N, 3] and positions [N, 3]: each with a neighbour of nearly the same colour."""
    random = np.random.default_rng(0)
    positions = random.normal(size=(2000, 3))
    smooth = np.sin(positions) + 0.1 * random.standard_t(3, (2000, 1)) + 0.05 * random.normal(size=(2000, 3))
    beside = positions + 1e-3 * random.normal(size=(2000, 3))
    near = smooth + 0.004 * random.standard_t(3, (2000, 3))
    return np.concatenate([smooth, near]), np.concatenate([positions, beside])


def noisy(colours: Doubles, seed: int) -> Doubles:
    new = colours.copy()
    new[:, 1:] += np.random.default_rng(seed).uniform(-NOISE, NOISE, (len(colours), 2))
    return new


def apart(colours: Doubles, positions: Doubles) -> Doubles:
    """Logarithms of quantiles of how much green differs between nearest neighbours."""
    nearest = cKDTree(positions).query(positions, k=2)[1][:, 1]
    quantiles = np.quantile(np.abs(colours[:, 1] - colours[nearest, 1]), (0.05, 0.1, 0.25, 0.5))
    return np.log(quantiles)


def test_what_is_admitted_leaves_differences_between_neighbours_as_they_were(
    model: tuple[Doubles, Doubles],
) -> None:
    colours, positions = model
    likelihood, new = Likelihood.of(colours, positions, noisy(colours, 1)), noisy(colours, 2)
    which = likelihood.accept(colours, new, np.random.default_rng(3))
    stego = colours.copy()
    stego[:, 1:] = np.where(which, new[:, 1:], colours[:, 1:])
    before = apart(colours, positions)
    assert np.abs(apart(stego, positions) - before).max() < 0.25
    assert np.abs(apart(new, positions) - before).max() > 1.0  # what all of the noise does
    assert 0.1 < which.mean() < 0.6  # half are of a kind that hardly ever may move


def test_numbers_that_should_stay_are_not_admitted(model: tuple[Doubles, Doubles]) -> None:
    colours, positions = model
    likelihood = Likelihood.of(colours, positions, noisy(colours, 1))
    assert not likelihood.accept(colours, colours, np.random.default_rng(0)).any()
    few = colours.copy()
    few[:200] = noisy(colours, 2)[:200]
    which = likelihood.accept(colours, few, np.random.default_rng(0))
    assert which[:200].any()
    assert not which[200:].any()


def test_independent_colours_may_all_change() -> None:
    random = np.random.default_rng(0)
    colours, positions = random.normal(size=(3000, 3)), random.normal(size=(3000, 3))
    likelihood = Likelihood.of(colours, positions, noisy(colours, 1))
    assert likelihood.accept(colours, noisy(colours, 2), random).mean() > 0.9


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_gaussians_and_equal_ones_are_no_trouble(count: int) -> None:
    colours, positions = np.zeros((count, 3)), np.zeros((count, 3))
    likelihood = Likelihood.of(colours, positions, noisy(colours, 1))
    assert likelihood.accept(colours, noisy(colours, 2), np.random.default_rng(0)).shape == (count, 2)
