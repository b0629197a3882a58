"""Numbers on lattices, IDs of Gaussians, and salts: one property each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from channels.colours.made import cover
from keyss.channels.colours import qim
from keyss.channels.colours.carriers import SALTS, Carriers, find_salts
from keyss.core import Gaussians
from lab.lifelike import turned

SECRET = bytes(range(16))
LEVEL = 24


def _written(level: int = LEVEL):
    """IDs [C, 4], values before and after [C, 2], bits of each [C], and code [B]."""
    carriers = Carriers.of(cover())
    ids, before = carriers.ids[carriers.representatives], carriers.colours[carriers.representatives, 1:]
    bits = qim.bit_counts(carriers.impact[carriers.representatives], level)
    code = np.random.default_rng(0).integers(0, 2, qim.COLUMNS * bits.sum()).astype(np.uint8)
    return ids, before, qim.write(SECRET, ids, before, bits, code), bits, code


@pytest.mark.parametrize("level", [qim.ONE, 4, 24, 40])
def test_bits_come_back_after_noise_below_half_of_the_spacing(level: int) -> None:
    ids, _, written, bits, code = _written(level)
    noise = np.random.default_rng(1).uniform(-0.0131, 0.0131, written.shape)  # as .spz rounds
    assert ((qim.read(SECRET, ids, written + noise, bits) < 0) == code).all()


def test_what_is_added_is_uniform_noise_of_the_stated_variance() -> None:
    _, before, written, bits, _ = _written()
    moved = (written - before)[bits > 0] / (qim.SPACING * 2.0**bits)[bits > 0, None]
    assert kstest(moved.ravel() + 0.5, "uniform").pvalue > 0.001
    assert abs(np.corrcoef(moved.T)[0, 1]) < 0.06
    assert (written[bits == 0] == before[bits == 0]).all()


def test_without_the_secret_nothing_lies_on_a_lattice() -> None:
    ids, _, written, bits, _ = _written(qim.ONE)
    sure = np.abs(qim.read(SECRET, ids, written, bits)).mean()
    assert np.abs(qim.read(bytes(16), ids, written, bits)).mean() < 0.9 * sure
    assert kstest(written.ravel() / qim.SPACING % 1, "uniform").pvalue > 0.001


def test_a_visible_gaussian_carries_less() -> None:
    impact = np.sort(Carriers.of(cover()).impact)
    for level in (10, 30):
        assert (np.diff(qim.bit_counts(impact, level)) <= 0).all()
    totals = [int(qim.bit_counts(impact, level).sum()) for level in range(1, qim.LEVELS)]
    assert totals == sorted(totals)


def test_names_survive_the_rounding_of_spz() -> None:
    """Log scales in sixteenths, colours and opacities in bytes: borders of bins are borders of rounding."""
    model = cover()
    rounded = replace(
        model,
        log_scales=(model.log_scales * 16).round() / 16,
        opacity_logits=torch.logit((model.opacities * 255).round().clamp(1, 254) / 255),
        sh=((model.sh * 38.25 + 127.5).round() - 127.5) / 38.25,
    )
    before, after = (Carriers.of(each) for each in (model, rounded))
    rows, mine, others = np.intersect1d(before.rows, after.rows, return_indices=True)
    assert len(rows) > 0.97 * len(before)
    assert (before.ids[mine] == after.ids[others]).all(axis=1).mean() > 0.99


def test_names_that_are_not_in_doubt_survive_noise() -> None:
    model = cover(20_000)
    noise = 0.009 * (2 * torch.rand(model.log_scales.shape, generator=torch.Generator().manual_seed(1)) - 1)
    moved = replace(model, log_scales=model.log_scales + noise)
    before, after = Carriers.of(model), Carriers.of(moved)
    changed = (before.ids != after.ids).any(axis=1)
    assert changed.mean() == pytest.approx(0.07, rel=0.15)  # 3 numbers, 0.144 / 2 of them to other sixteenths
    assert changed[after.error_probability == 0].mean() < 0.003  # both scales of a ratio change: 0.07^2


@pytest.mark.parametrize("scale", [1.0, 1.37, 0.4])
def test_names_do_not_depend_on_order_or_frame(scale: float) -> None:
    """But for one alignment of four, which makes up for most of a scaling."""
    model = cover(2000)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(0))
    before, moved = Carriers.of(model), turned(scale)(model)
    after = [Carriers.of(moved, each / 4) for each in range(4)]
    best = max((each.ids == before.ids).all(axis=1).mean() for each in after)
    assert best == 1.0 if scale == 1 else best > 0.85
    assert sorted(map(bytes, Carriers.of(model[order]).ids)) == sorted(map(bytes, before.ids))


def test_one_of_each_name_is_written() -> None:
    carriers = Carriers.of(Gaussians.cat([cover(300)] * 2))
    ids = carriers.ids[carriers.representatives]
    assert len(np.unique(ids, axis=0)) == len(ids) == len(np.unique(carriers.ids, axis=0))
    assert (carriers.certainty <= 0.5).all()


def test_salts_are_found_again_after_rounding_and_pruning() -> None:
    model = cover(6000)
    carriers = Carriers.of(model)
    salts = find_salts(carriers)[1]
    assert len(salts) == SALTS
    sh = model.sh.clone()
    sh[carriers.rows, 0] = torch.from_numpy(
        (np.round(carriers.colours * 38.25 + 127.5) - 127.5) / 38.25
    ).float()
    kept = torch.rand(6000, generator=torch.Generator().manual_seed(3)) < 0.75
    rounded = replace(model, log_scales=(model.log_scales * 16).round() / 16, sh=sh)[kept]
    assert len(set(find_salts(Carriers.of(turned(1.37)(rounded)))[1]) & set(salts)) >= 3
