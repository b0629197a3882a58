"""The kernels of records against numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from channels.low_bits.trained_like import trained_like
from keyss.core import Gaussians
from keyss.methods.records.packing import codes_of_records
from keyss.methods.records.quantise import Codec, _bits, _numbers, outliers
from keyss.methods.records.table import Table
from methods.records import reference

LARGEST = float(np.finfo(np.float32).max)
ANY = st.one_of(st.floats(-LARGEST, LARGEST, width=32), st.floats(-5, 5, width=32))


@given(st.data(), st.integers(0, 3), st.sampled_from([0, 5, 100, 700]))
@settings(max_examples=40, deadline=None)
def test_any_finite_numbers_become_the_same_records_and_come_back(
    data: st.DataObject, degree: int, more: int
) -> None:
    count = data.draw(st.integers(1, 12))
    shapes = ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3))
    model = Gaussians(
        *(
            torch.from_numpy(data.draw(arrays.arrays(np.float32, (count, *shape), elements=ANY)))
            for shape in shapes
        )
    )
    table = Table.of_size(Table.floor(degree).total + more, degree)
    assert table is not None
    codec = Codec.fit(model, table)
    assert (outliers(model) == reference.outliers(model)).all()
    assert (_numbers(model)[4] == model.overflow.numpy()).all()
    records = codec.encode(model)
    # The last digits of a logarithm are anybody's: codes may differ where a number is half way between two.
    # Of grey colours the differences are nothing but such digits.
    theirs = _codes(reference.encode(codec, model), codec)
    for mine, expected in list(zip(_codes(records, codec), theirs, strict=True))[:8]:
        assert (np.abs(mine.astype(np.int64) - expected.astype(np.int64)) <= 1).all()
    _same(codec.decode(records), reference.decode(codec, records))


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("more", [0, 30, 400])
def test_records_of_a_model_are_the_same(degree: int, more: int) -> None:
    model = trained_like(3000, degree, degree)
    model.means[5] = 1e5
    table = Table.of_size(Table.floor(degree).total + more, degree)
    assert table is not None
    codec = Codec.fit(model, table)
    records = codec.encode(model)
    assert (records == reference.encode(codec, model)).all()
    assert records.max() == 255
    back = codec.decode(records)
    _same(back, reference.decode(codec, records))
    assert Codec.fit(model, table) == codec


@given(st.data(), st.integers(0, 3))
@settings(max_examples=20, deadline=None)
def test_any_records_are_read_as_numpy_reads_them(data: st.DataObject, degree: int) -> None:
    codec = Codec.fit(trained_like(50, 1, degree), Table.floor(degree))
    records = data.draw(arrays.arrays(np.uint8, (5, codec.table.record_bytes)))
    _same(codec.decode(records), reference.decode(codec, records))


def test_lines_do_not_depend_on_the_number_of_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    model, table = trained_like(2000, 3, 1), Table.floor(1)
    whole = Codec.fit(model, table)
    monkeypatch.setattr("keyss.methods.records.quantise._BLOCK", 77)
    assert Codec.fit(model, table) == whole
    assert (whole.encode(model) == reference.encode(whole, model)).all()


def _codes(records: np.ndarray, codec: Codec) -> list[np.ndarray]:
    """[N, C] the codes of each line, outlier bit and quaternion included."""
    means, log_scales, quats, opacity, *_ = codec.table.bits
    widths = [(1, 1), (1, 2), (3, quats), (1, means), (1, means), (1, means), (3, log_scales), (1, opacity)]
    counts = [each * (2 * band + 1) for band in range(codec.table.sh_degree + 1) for each in (1, 2)]
    widths += zip(counts, _bits(codec.table)[5:].tolist(), strict=True)
    return codes_of_records(records, widths)


def _same(one: Gaussians, other: Gaussians) -> None:
    """To the last digit of single precision, in which one kind of sinh may differ from another."""
    for name, mine in vars(one).items():
        np.testing.assert_allclose(mine.numpy(), getattr(other, name).numpy(), rtol=2e-7, atol=1e-12)
