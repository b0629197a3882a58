"""Somebody who knows the source counts: frequencies keep their shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy import stats

from channels.lsb.quantised import FORMATS, bits_of, codes_of, written
from channels.lsb.trained_like import trained_like
from keyss.channels import Field, QuantisedCover, in_counted_order
from keyss.channels.lsb.fields import ROTATIONS
from keyss.core import Gaussians
from keyss.files.formats.common import in_morton_order

COUNT = 30_000


@pytest.fixture(scope="module", params=FORMATS)
def file(request: pytest.FixtureRequest) -> tuple[str, QuantisedCover, Any]:
    """Its suffix, the cover, and its values with something in them."""
    cover = QuantisedCover.of(codes_of(request.param, COUNT))
    return request.param, cover, written(cover, b"x" * 5000)


def pairs_of_values(levels: npt.NDArray[np.int32]) -> float:
    """p-value of the attack of Westfeld and Pfitzmann (1999): tiny unless 2i and 2i + 1 are equally often."""
    counts = np.bincount(levels - levels.min() // 2 * 2)
    counts = np.append(counts, np.zeros(len(counts) % 2, np.int64)).reshape(-1, 2)
    counts = counts[counts.sum(axis=1) > 10]
    expected = counts.mean(axis=1)
    return float(stats.chi2.sf(((counts[:, 0] - expected) ** 2 / expected).sum(), len(counts) - 1))


def test_written_bits_are_uniform(file: tuple[str, QuantisedCover, Any]) -> None:
    _, cover, codes = file
    values = np.packbits(bits_of(codes)[cover.dry == 1])
    assert stats.chisquare(np.bincount(values, minlength=256)).pvalue > 1e-4


def test_pairs_of_values_find_overwriting_and_not_matching() -> None:
    rng = np.random.default_rng(0)
    # A steep and narrow distribution, as that of opacities: there pairs differ most.
    levels = np.rint(rng.exponential(9, 60_000)).astype(np.int32) + 10
    bits = rng.integers(0, 2, len(levels)).astype(np.int32)
    overwritten = (levels & ~1) | bits
    field = Field("opacities", 0, levels, np.ones_like(levels))
    found = field.with_bits(bits.astype(np.uint8), rng.uniform(-0.5, 0.5, len(levels)))
    assert np.array_equal(found & 1, bits)
    assert max(pairs_of_values(levels), pairs_of_values(found)) < 1e-9 < 1e-3 < pairs_of_values(overwritten)


def test_columns_look_like_those_of_the_untouched_file(file: tuple[str, QuantisedCover, Any]) -> None:
    """Frequencies of levels, in bins of a few, by a test of two random samples."""
    suffix, cover, codes = file
    after = in_counted_order(codes)[2]
    other = in_counted_order(codes_of(suffix, COUNT, seed=1))[2]
    for old, new, null in zip(cover.fields, after, other, strict=True):
        plain, stego, fresh = (each.levels for each in (old, new, null))
        size = 1 << max(0, int(np.log2(np.ptp(plain) / 50)))
        edges = np.arange(min(plain.min(), fresh.min()), max(plain.max(), fresh.max()) + 2 * size, size)
        counts = [np.histogram(each, edges)[0] for each in (plain, stego, fresh)]
        moved, natural = (np.abs(each - counts[0]).sum() for each in counts[1:])
        assert moved < natural, (new.name, new.column, moved, natural, size)


def test_ends_of_ranges_stay(file: tuple[str, QuantisedCover, Any]) -> None:
    _, cover, codes = file
    after = in_counted_order(codes)[2]
    for old, new in zip(cover.fields, after, strict=True):
        if old.name == "rotations":
            continue  # whose ends are those of the format
        for end in (old.levels.min(), old.levels.max()):
            assert np.array_equal(old.levels == end, new.levels == end), old.name


def hardly_trained(count: int = 20_000) -> Gaussians:
    """A fortieth is nearly round and hardly rotated, as before training."""
    model = trained_like(count, sh_degree=0)
    few, small = slice(count // 40), trained_like(count // 40, 1, 0)
    model.log_scales[few] = model.log_scales[few, :1] + 2e-3 * (small.log_scales + 4)
    model.quats[few] = torch.tensor([1.0, 0, 0, 0]) + 2e-3 * small.quats
    return in_morton_order(replace(model, opacity_logits=model.opacity_logits.clamp_min(-4)))


def coincidences(codes: Any) -> dict[str, int]:
    """The numbers of small rotations, of rotations with equal parts, and of round Gaussians."""
    middle = sum(ROTATIONS[type(codes)]) / 2
    fields = in_counted_order(codes)[2]
    parts = np.abs(np.stack([field.levels for field in fields if field.name == "rotations"], axis=1) - middle)
    sizes = np.ptp(codes.dequantise().log_scales.numpy(), axis=1)
    return {
        "small": int((parts.max(axis=1) < 2).sum()),
        "equal": int((parts[:, 0] == parts[:, 1]).sum()),
        "round": int((sizes < 4e-3).sum()),
    }


@pytest.mark.parametrize("suffix", FORMATS)
def test_there_are_as_many_coincidences_as_before(suffix: str) -> None:
    cover = QuantisedCover.of(FORMATS[suffix].quantise(hardly_trained()))
    before, after = coincidences(cover.codes), coincidences(written(cover, b"x" * 5000))
    for name, count in before.items():
        assert count > 80
        assert abs(after[name] - count) < 6 * count**0.5, name
