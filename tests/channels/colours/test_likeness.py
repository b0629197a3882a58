"""Changes that leave a model as likely as it was: what is usual between neighbours stays so."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from keyss.channels.colours import carriers
from keyss.channels.colours.likeness import Likeness
from keyss.channels.colours.salts import Salts, moved, renewed
from measure.lifelike import lifelike

NOISE = 0.0275


@pytest.fixture(scope="module")
def model() -> tuple[carriers.Doubles, carriers.Doubles]:
    """Colours [N, 3] and positions [N, 3]: each with a neighbour of nearly the same colour."""
    random = np.random.default_rng(0)
    positions = random.normal(size=(2000, 3))
    smooth = np.sin(positions) + 0.1 * random.standard_t(3, (2000, 1)) + 0.05 * random.normal(size=(2000, 3))
    beside = positions + 1e-3 * random.normal(size=(2000, 3))
    near = smooth + 0.004 * random.standard_t(3, (2000, 3))
    return np.concatenate([smooth, near]), np.concatenate([positions, beside])


def noisy(colours: carriers.Doubles, seed: int) -> carriers.Doubles:
    new = colours.copy()
    new[:, 1:] += np.random.default_rng(seed).uniform(-NOISE, NOISE, (len(colours), 2))
    return new


def apart(colours: carriers.Doubles, positions: carriers.Doubles) -> carriers.Doubles:
    """Logarithms of quantiles of how much green differs between nearest neighbours."""
    nearest = cKDTree(positions).query(positions, k=2)[1][:, 1]
    quantiles = np.quantile(np.abs(colours[:, 1] - colours[nearest, 1]), (0.05, 0.1, 0.25, 0.5))
    return np.log(quantiles)


def test_what_is_admitted_leaves_differences_between_neighbours_as_they_were(
    model: tuple[carriers.Doubles, carriers.Doubles],
) -> None:
    colours, positions = model
    likeness, new = Likeness.of(colours, positions, noisy(colours, 1)), noisy(colours, 2)
    which = likeness.admitted(colours, new, np.random.default_rng(3))
    stego = colours.copy()
    stego[:, 1:] = np.where(which, new[:, 1:], colours[:, 1:])
    before = apart(colours, positions)
    assert np.abs(apart(stego, positions) - before).max() < 0.25
    assert np.abs(apart(new, positions) - before).max() > 1.0  # what all of the noise does
    assert 0.1 < which.mean() < 0.6  # half are of a kind that hardly ever may move


def test_numbers_that_should_stay_are_not_admitted(model: tuple[carriers.Doubles, carriers.Doubles]) -> None:
    colours, positions = model
    likeness = Likeness.of(colours, positions, noisy(colours, 1))
    assert not likeness.admitted(colours, colours, np.random.default_rng(0)).any()
    few = colours.copy()
    few[:200] = noisy(colours, 2)[:200]
    which = likeness.admitted(colours, few, np.random.default_rng(0))
    assert which[:200].any()
    assert not which[200:].any()


def test_independent_colours_may_all_change() -> None:
    random = np.random.default_rng(0)
    colours, positions = random.normal(size=(3000, 3)), random.normal(size=(3000, 3))
    likeness = Likeness.of(colours, positions, noisy(colours, 1))
    assert likeness.admitted(colours, noisy(colours, 2), random).mean() > 0.9


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_gaussians_and_equal_ones_are_no_trouble(count: int) -> None:
    colours, positions = np.zeros((count, 3)), np.zeros((count, 3))
    likeness = Likeness.of(colours, positions, noisy(colours, 1))
    assert likeness.admitted(colours, noisy(colours, 2), np.random.default_rng(0)).shape == (count, 2)


def test_salts_move_by_whole_cells_to_where_colours_are_usual() -> None:
    """Green and blue of these models are near red, as those of trained ones are: salts should stay so."""
    cover = lifelike(4000, 0).with_sh_degree(0)
    numbers = carriers.Numbers.of(cover)
    random = np.random.default_rng(0)
    grey = numbers.colours[:, :1] + 0.05 * random.normal(size=(len(numbers.rows), 3))
    numbers = carriers.Numbers(numbers.rows, numbers.log_scales, numbers.opacities, grey)
    positions = cover.means.double().numpy()[numbers.rows]
    likeness = Likeness.of(grey, positions, moved(grey, np.random.default_rng(1)))
    rows = Salts.of(numbers).rows
    apart = {}
    for name, judge in (("likely", likeness), ("any", None)):
        new = renewed(numbers, np.random.default_rng(2), judge).colours
        cells = (new - grey) / (5 * carriers.COLOUR_STEP)
        assert np.abs(cells - cells.round()).max() < 1e-9
        assert (np.delete(new, rows, axis=0) == np.delete(grey, rows, axis=0)).all()
        apart[name] = float(np.abs(new[rows, 1] - new[rows, 0]).mean())
    assert apart["likely"] < 0.5 * apart["any"]
