"""Several hidings in one cover, copies of a file, and files that were put together."""

from __future__ import annotations

import warnings

import pytest
import torch

from channels.low_bits.payloads import embed, embed_contents, extract
from channels.low_bits.trained_like import keys, trained_like
from keyss.channels import LOW_BITS, LowBitsReader, RecordRequest, Records
from keyss.core import Gaussians, KeyssWarning

KEY = "the right key"


def _carried(cover: Gaussians, count: int) -> Gaussians:
    prepared = LOW_BITS.prepare(cover)
    (plan,) = prepared.cells.plan_records([RecordRequest(count, 33, 10)])
    data = torch.randint(256, (count, plan.record_bytes), dtype=torch.uint8).numpy()
    records = Records("test", bytes(10), data, plan, torch.arange(plan.copies).numpy())
    return embed_contents(prepared, [(keys(1), records)])


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(1500, 4)


def test_two_hidings_in_one_cover_have_no_salt_in_common(cover: Gaussians) -> None:
    first, second = (LowBitsReader.of(_carried(cover, 50)).salts for _ in range(2))
    assert len(set(first)) == len(set(second)) == 12
    assert not set(first) & set(second)


def test_copies_count_once(cover: Gaussians) -> None:
    stego = _carried(cover, 200)
    five = Gaussians.cat([stego] * 5)[torch.randperm(5 * len(stego))]
    one, other = (LowBitsReader.of(model).extract(keys(1)[0]) for model in (stego, five))
    assert isinstance(one, Records)
    assert isinstance(other, Records)
    assert len(one.records) == len(other.records) == 200
    assert {row.tobytes() for row in one.records} == {row.tobytes() for row in other.records}


def test_a_key_that_opens_two_secrets_says_so(cover: Gaussians) -> None:
    """Where two files under one key were merged."""
    first, second = embed(cover, [(KEY, b"first")]), embed(trained_like(1500, 5), [(KEY, b"second")])
    with pytest.warns(KeyssWarning, match="opens two secrets"):
        assert extract(Gaussians.cat([first, second]), KEY) in (b"first", b"second")


def test_who_adds_or_removes_gaussians_is_not_warned(cover: Gaussians) -> None:
    stego = embed(cover, [(KEY, b"first")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert extract(Gaussians.cat([stego, trained_like(1500, 14)])[500:], KEY) == b"first"
