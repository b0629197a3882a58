"""Numbers on lattices, names of Gaussians, and salts: one property each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from channels.colours.made import cover
from keyss.channels.colours import lattice
from keyss.channels.colours.carriers import CELL, SALTS, Carriers, Numbers, Salts, renewed
from keyss.core import Gaussians

SECRET = bytes(range(16))
LEVEL = 44


def _own(model: Gaussians | None = None):
    carriers = Numbers.of(cover() if model is None else model).carriers(-4.0)
    return carriers[carriers.one_of_each()]


def _written(level: int = LEVEL):
    own = _own()
    bits = _bits(own, level)
    code = np.random.default_rng(0).integers(0, 2, lattice.COLUMNS * bits.sum()).astype(np.uint8)
    return own, code, replace(own, values=lattice.write(SECRET, own, bits, code))


def _bits(carriers: Carriers, level: int = LEVEL):
    return lattice.bit_counts(carriers, level, lattice.MAX_BITS)


@pytest.mark.parametrize("level", [20, 44, 55])
def test_bits_come_back_after_noise_below_half_of_the_spacing(level: int) -> None:
    own, code, written = _written(level)
    noise = np.random.default_rng(1).uniform(-0.0131, 0.0131, own.values.shape)  # as .spz rounds
    noisy = replace(written, values=written.values + noise)
    dither = lattice.dithers(SECRET, own.names)
    ratios = lattice.read(dither, noisy, _bits(own, level), np.zeros(len(own)))
    assert ((ratios < 0) == code).all()


def test_what_is_added_is_uniform_noise_of_the_stated_variance() -> None:
    own, _, written = _written()
    bits = _bits(own)
    steps = (lattice.SPACING * 2.0**bits)[bits > 0, None]
    moved = (written.values - own.values)[bits > 0] / steps
    assert kstest(moved.ravel() + 0.5, "uniform").pvalue > 0.001
    assert abs(np.corrcoef(moved.T)[0, 1]) < 0.06
    assert (written.values[bits == 0] == own.values[bits == 0]).all()


def _fit(secret: bytes, carriers: Carriers) -> float:
    """How well values lie on the lattice: 0 by chance, 1 on its points."""
    bits = _bits(carriers)
    place = carriers.values / lattice.SPACING - lattice.dithers(secret, carriers.names) * 2.0 ** bits[:, None]
    return float(np.cos(2 * np.pi * place[bits > 0]).mean())


def test_without_the_secret_nothing_lies_on_a_lattice() -> None:
    _, _, written = _written()
    assert _fit(SECRET, written) > 0.999
    assert abs(_fit(bytes(16), written)) < 4 / math.sqrt(len(written))
    place = written.values.ravel() / lattice.SPACING % 1
    assert kstest(place, "uniform").pvalue > 0.001


def test_a_visible_gaussian_carries_less() -> None:
    own = _own()
    bits = _bits(own)
    assert bits.max() == lattice.MAX_BITS
    order = np.argsort(own.impact)
    assert (np.diff(bits[order]) <= 0).all()
    totals = [int(_bits(own, level).sum()) for level in range(lattice.LEVELS)]
    assert totals == sorted(totals)


def test_names_survive_the_rounding_of_spz() -> None:
    """Log scales in sixteenths, colours and opacities in bytes: borders of cells are borders of rounding."""
    model = cover()
    rounded = replace(
        model,
        log_scales=(model.log_scales * 16).round() / 16,
        opacity_logits=torch.logit((model.opacities * 255).round().clamp(1, 254) / 255),
        sh=((model.sh * 38.25 + 127.5).round() - 127.5) / 38.25,
    )
    before, after = (Numbers.of(each).carriers(-4.0) for each in (model, rounded))
    rows, mine, others = np.intersect1d(before.rows, after.rows, return_indices=True)
    assert len(rows) > 0.97 * len(before)
    same = (before.names[mine] == after.names[others]).all(axis=1)
    assert same.mean() > 0.995


def test_the_doubt_of_a_name_is_the_chance_that_it_changes() -> None:
    model = cover(20_000)
    noise = 0.018 * (2 * torch.rand(model.log_scales.shape, generator=torch.Generator().manual_seed(1)) - 1)
    moved = replace(model, log_scales=model.log_scales + noise)
    before, after = (Numbers.of(each).carriers(-4.0) for each in (model, moved))
    changed = (before.names[:, :3] != after.names[:, :3]).any(axis=1)
    assert changed.mean() == pytest.approx(3 * 0.018 / 2 / CELL, rel=0.1)
    assert changed[after.doubt == 0].mean() < 0.001
    assert changed.mean() < after.doubt.mean() < 2 * changed.mean()  # of opacity and red there is some, too


def test_names_do_not_depend_on_order_or_frame() -> None:
    model = cover(500)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    moved = replace(model, means=3 - 2 * model.means, quats=model.quats.flip(1))[order]
    before, after = (Numbers.of(each).carriers(-4.0) for each in (model, moved))
    assert sorted(map(bytes, before.names)) == sorted(map(bytes, after.names))


def test_one_of_each_name_is_written() -> None:
    model = Gaussians.cat([cover(300)] * 2)
    carriers = Numbers.of(model).carriers(-4.0)
    own = carriers[carriers.one_of_each()]
    assert len(np.unique(own.names, axis=0)) == len(own) == len(np.unique(carriers.names, axis=0))
    assert (carriers.namesakes() >= 2).all()


def test_salts_are_new_and_are_found_again_after_rounding_and_pruning() -> None:
    numbers = Numbers.of(cover(6000))
    first, second = (renewed(numbers, np.random.default_rng(seed)) for seed in (1, 2))
    one, other = Salts.of(first), Salts.of(second)
    assert len(one.salts) >= SALTS
    assert len(set(one.salts) & set(other.salts)) <= 2  # 1/49 of 16 are expected
    kept = np.random.default_rng(3).random(len(first.rows)) < 0.75
    rounded = Numbers(
        first.rows[kept], first.log_scales[kept], first.opacities[kept], first.colours[kept]
    ).rounded()
    assert len(set(Salts.of(rounded).salts[:SALTS]) & set(one.salts[:SALTS])) >= 3


def test_new_salts_leave_each_number_where_it_lies_in_its_cell() -> None:
    numbers = Numbers.of(cover())
    moved = renewed(numbers, np.random.default_rng(1)).colours - numbers.colours
    cells = moved * 38.25 / 5
    assert np.abs(cells - cells.round()).max() < 1e-9
    assert 1 <= (moved != 0).any(axis=1).sum() <= SALTS
    assert (moved[:, 0] == 0).all()
