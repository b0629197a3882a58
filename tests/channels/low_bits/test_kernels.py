"""The kernels of low bits against hashlib and numpy, for any words that a file may hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from channels.low_bits import reference
from channels.low_bits.trained_like import rounded, trained_like
from keyss.channels.low_bits import bits, multiples, salts, usable
from keyss.channels.low_bits.bits import Layout, used_words
from keyss.channels.low_bits.reading import _are_among
from keyss.core import Gaussians
from keyss.rendering.cpu.parallel import in_blocks

SHAPES = ((3,), (4,), (3,), ())


@st.composite
def models(draw: st.DrawFn) -> Gaussians:
    """Any bit patterns at all, infinities and what is no number included, or quaternions of length 1."""
    count, degree = draw(st.integers(1, 20)), draw(st.integers(0, 3))
    words = [
        draw(arrays.arrays(np.uint32, (count, *shape), elements=st.integers(0, 2**32 - 1)))
        for shape in (*SHAPES, ((degree + 1) ** 2, 3))
    ]
    model = Gaussians(*(torch.from_numpy(each.view(np.float32)) for each in words))
    if draw(st.booleans()):
        model.quats[:] = torch.tensor([0.6, 0, 0.8, 0])
    return model


@given(models())
@settings(max_examples=60, deadline=None)
def test_identities_are_those_of_hashlib(model: Gaussians) -> None:
    assert (bits.identities(model) == reference.identities(model)).all()


@given(models(), st.data())
@settings(max_examples=60, deadline=None)
def test_low_bits_are_read_and_written_as_the_format_says(model: Gaussians, data: st.DataObject) -> None:
    low = bits.read_low_bits(model)
    assert (low == reference.read_low_bits(model)).all()
    rows = np.array(data.draw(st.permutations(range(len(model))))[: len(model) // 2 + 1])
    new = data.draw(arrays.arrays(np.uint8, (len(rows), low.shape[1])))
    before = used_words(model)
    written = bits.write_low_bits(model, rows, new)
    assert (used_words(written) == reference.written_words(model, rows, new)).all()
    assert (used_words(model) == before).all()
    assert (bits.read_low_bits(written)[rows] == new).all()


def _with_clones(model: Gaussians) -> Gaussians:
    clones = model[:40].map(lambda values: values * (1 + 2e-7))
    return Gaussians.cat([model, model[50:60], replace(clones, means=clones.means + 0.01)])


def _with_short_and_frequent(model: Gaussians) -> Gaussians:
    model = model.map(torch.clone)
    model.sh[:30, 1:] = 0
    model.sh[30:60, -1, 1] = 0.25
    model.opacity_logits[100:130] = 0.1234567
    model.quats[:100] = torch.tensor([1.0, 0, 0, 0])
    model.quats[200:300] = torch.nn.functional.normalize(model.quats[200:300], dim=1)
    model.sh[300:340, -1] = model.sh[300:340, model.sh.shape[1] // 2]
    return model


def _unit(model: Gaussians) -> Gaussians:
    return replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))


@pytest.mark.parametrize("change", [Gaussians.detach, rounded, _with_clones, _with_short_and_frequent, _unit])
@pytest.mark.parametrize("degree", range(4))
def test_the_same_gaussians_are_left_alone_and_are_salts(change, degree: int) -> None:  # type: ignore[no-untyped-def]
    model = change(trained_like(1500, degree, degree))
    expected = reference.usable_carriers(model)
    assert 0 < expected.sum() < len(model)
    assert (usable.usable_carriers(model) == expected).all()
    layout = Layout.of(model)
    assert (salts._ranks(model, layout) == reference.ranks(used_words(model), layout)).all()
    for found, known in zip(usable._frequent_values(model), reference.frequent_values(model), strict=True):
        assert (found == known).all()


@given(arrays.arrays(np.uint64, st.integers(0, 300), elements=st.integers(0, 40)), st.integers(0, 60))
def test_what_occurs_twice_is_found_whatever_it_is(values: np.ndarray, shift: int) -> None:
    values = values << np.uint64(shift)
    times = {value: int((values == value).sum()) for value in values.tolist()}
    assert multiples.repeated(values).tolist() == [times[value] > 1 for value in values.tolist()]


@given(arrays.arrays(np.uint32, (60, 4), elements=st.integers(0, 30)), st.integers(0, 3), st.integers(2, 300))
def test_no_frequent_value_is_missed(values: np.ndarray, first: int, least: int) -> None:
    flat = values[:, first:]
    found = multiples.crowded(values, first, least)
    for value in np.unique(flat):
        if (times := int((flat == value).sum())) >= least:
            assert (found == value).sum() == times


def test_counts_stop_at_255_and_those_of_threads_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.full((700, 1), 7, np.uint32)
    for threads in (1, 2, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert len(multiples.crowded(values, 0, 600)) == 700
        assert len(multiples.crowded(values[:200], 0, 200)) == 200
        assert len(multiples.crowded(values[:200], 0, 201)) == 0


@given(arrays.arrays(np.uint8, (12, 11), elements=st.integers(0, 1)), st.integers(0, 12))
def test_rows_among_others(rows: np.ndarray, split: int) -> None:
    own, others = rows[:split], rows[split:]
    known = {row.tobytes() for row in others}
    assert _are_among(own, others).tolist() == [row.tobytes() in known for row in own]


def test_rows_of_one_hash_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "keyss.channels.low_bits.reading._hashes", lambda rows: np.zeros(len(rows), np.uint64)
    )
    rows = np.random.default_rng(0).integers(0, 256, (20, 9), dtype=np.uint8)
    assert _are_among(rows, rows[5:10]).tolist() == [5 <= row < 10 for row in range(20)]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_blocks_come_in_order_and_failures_come_through(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr("keyss.rendering.cpu.parallel._CORES", 8)
    assert in_blocks(lambda start, stop: (start, stop), 10, 4) == [(0, 4), (4, 8), (8, 10)]
    assert in_blocks(lambda start, stop: start, 0, 4) == []
    with pytest.raises(ZeroDivisionError):
        in_blocks(lambda start, stop: 1 // (start - 8), 20, 4)
