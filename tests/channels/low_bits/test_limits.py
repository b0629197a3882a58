"""What a hostile file may make a reader spend: written by somebody who knows which key will be tried."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from channels.low_bits.trained_like import keys, trained_like
from keyss.channels import LOW_BITS, LowBitsReader, Payload, reed_solomon
from keyss.channels.low_bits import spread, writing
from keyss.channels.low_bits.parameters import PayloadParameters, RecordParameters
from keyss.core import Gaussians, InputError
from keyss.keys import encryption


@contextmanager
def at_most(megabytes: float) -> Iterator[None]:
    """More memory than there was before, as numpy and Python take it."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < megabytes * 1e6
    finally:
        tracemalloc.stop()


def test_short_data_become_no_large_payload() -> None:
    packed = zlib.compress(bytes(60 << 20), 9)
    plain = struct.pack("<I", len(packed)) + packed
    bomb = encryption._cipher(bytes(32)).encrypt(encryption._NONCE, plain, b"")
    assert len(bomb) < 64_000
    with at_most(8), pytest.raises(InputError, match="larger than"):
        encryption.decrypt(bytes(32), bomb)


@pytest.mark.parametrize("size", [encryption.SMALL_PAYLOAD, encryption.SMALL_PAYLOAD + 1, 5 << 20])
def test_payloads_that_compress_too_well_come_out_all_the_same(size: int) -> None:
    assert encryption.decrypt(bytes(32), encryption.encrypt(bytes(32), bytes(size))) == bytes(size)


def test_as_many_blocks_as_there_can_be_take_no_memory() -> None:
    most = spread.Spread(spread.MAX_BLOCKS, reed_solomon.MAX_CHUNKS, reed_solomon.MAX_CHUNKS, 66)
    with at_most(1), pytest.raises(InputError, match="too much of the model was removed"):
        most.decode(np.zeros((100, 69), np.uint8), most.capacity)


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(3000, 3)


@pytest.mark.parametrize(
    "hostile",
    [
        lambda found: replace(
            found, spread=spread.Spread(spread.MAX_BLOCKS, 255, 255, 66), size=1_000_000_000
        ),
        lambda found: RecordParameters("carry", 1, 71, bytes(4096)),
        lambda found: RecordParameters("carry", 1, 65_535, b""),
        lambda found: RecordParameters("carry", 4, 60, b""),
    ],
    ids=["blocks", "header", "records", "cells"],
)
def test_hostile_parameters_end_in_a_sentence(
    cover: Gaussians, hostile: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def packed(method: str, size: int, own: spread.Spread) -> object:
        return hostile(PayloadParameters(method, size, own))  # type: ignore[operator]

    monkeypatch.setattr(writing, "PayloadParameters", packed)
    stego = LOW_BITS.prepare(cover).embed_derived([(keys(), Payload("carry", b"x"))])
    reader = LowBitsReader.of(stego)
    with at_most(10), pytest.raises(InputError, match=r"the key is right|are damaged"):
        reader.extract(keys()[0])
