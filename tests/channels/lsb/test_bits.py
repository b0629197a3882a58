"""Low bits and IDs against hashlib and the text of the format, for any words that a file may hold."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays

from keyss.channels import DEPTHS, Layout, gaussian_ids, read_low_bits, used_words, write_low_bits
from keyss.core import Gaussians
from keyss.core.arrays import frequent, repeated
from keyss.kernels.parallel import in_blocks

SHAPES = ((3,), (4,), (3,), ())


@st.composite
def models(draw: st.DrawFn) -> Gaussians:
    """Any bit patterns at all, infinities and what is no number included, or quaternions of length 1."""
    count, degree = draw(st.integers(1, 20)), draw(st.integers(0, 3))
    words = [
        draw(arrays.arrays(np.uint32, (count, *shape), elements=st.integers(0, 2**32 - 1)))
        for shape in (*SHAPES, ((degree + 1) ** 2, 3))
    ]
    model = Gaussians(*(torch.from_numpy(word.view(np.float32)) for word in words))
    if draw(st.booleans()):
        model.quats[:] = torch.tensor([0.6, 0, 0.8, 0])
    return model


def masks(model: Gaussians, depth: int = 8) -> list[int]:
    """Of the fields that are used: `depth` bits above the last one, none of unit quaternions."""
    mask = (1 << depth) - 1 << 1
    quats = [mask if Layout.of(model).quats else 0] * 4
    return [mask] * 3 + quats + [mask] * (1 + 3 * ((model.sh_degree + 1) ** 2 - 1))


@given(models())
@settings(max_examples=60, deadline=None)
def test_identities_are_those_of_hashlib(model: Gaussians) -> None:
    stays = used_words(model) & ~np.array(masks(model), np.uint32)
    rows = np.concatenate([model.means.numpy().view(np.uint32), stays], axis=1)
    hashes = [
        hashlib.blake2b(row.astype("<u4").tobytes(), digest_size=16, person=b"keyss/identity").digest()
        for row in rows
    ]
    assert [each.tobytes() for each in gaussian_ids(model)] == hashes


@given(models(), st.sampled_from(DEPTHS), st.data())
@settings(max_examples=60, deadline=None)
def test_low_bits_are_read_and_written_as_the_format_says(
    model: Gaussians, depth: int, data: st.DataObject
) -> None:
    layout, low = Layout.of(model), read_low_bits(model, depth)
    for row, found in zip(used_words(model).tolist(), low, strict=True):
        bits = "".join(
            f"{word >> 1 & mask >> 1:0{(mask >> 1).bit_length()}b}"
            for word, mask in zip(row, masks(model, depth), strict=True)
            if mask
        )
        assert found.tobytes() == bytes(int(bits[8 * i : 8 * i + 8], 2) for i in range(len(bits) // 8))
    rows = np.array(data.draw(st.permutations(range(len(model))))[: len(model) // 2 + 1])
    new = data.draw(arrays.arrays(np.uint8, (len(rows), low.shape[1])))
    before = used_words(model)
    written = write_low_bits(model, layout, [(depth, rows, new)])
    after, mask = used_words(written), np.array(masks(model, depth), np.uint32)
    fields = np.flatnonzero(mask)
    rest = depth * len(fields) % 8  # bits of the last field, or two, stay
    for field in fields[::-1][: -(-rest // depth)]:
        mask[field] &= ~np.uint32((1 << min(rest, depth)) - 1 << 1)
        rest = max(0, rest - depth)
    assert (used_words(model) == before).all()
    assert (read_low_bits(written, depth, layout)[rows] == new).all()
    others = np.setdiff1d(np.arange(len(model)), rows)
    assert (after[others] == before[others]).all()
    assert (after & ~mask == before & ~mask).all()
    assert (written.means.view(torch.int32) == model.means.view(torch.int32)).all()


@given(st.lists(st.integers(0, 40), max_size=90), st.integers(1, 5), st.sampled_from([np.uint32, np.uint64]))
def test_frequent_values_are_those_that_counting_finds(values: list[int], times: int, kind: type) -> None:
    words = np.array(values, kind) << kind(20)
    found, counts = np.unique(words, return_counts=True)
    assert np.array_equal(frequent(words[:, None], times), found[counts >= times])
    assert np.array_equal(repeated(words), np.isin(words, found[counts > 1]))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_blocks_come_in_order_and_failures_come_through(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr("keyss.kernels.parallel._CORES", 8)
    assert in_blocks(lambda start, stop: (start, stop), 10, 4) == [(0, 4), (4, 8), (8, 10)]
    assert in_blocks(lambda start, stop: start, 0, 4) == []
    with pytest.raises(ZeroDivisionError):
        in_blocks(lambda start, stop: 1 // (start - 8), 20, 4)
