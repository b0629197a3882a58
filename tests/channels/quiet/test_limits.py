"""What a hostile file may make a reader spend: written by somebody who knows which key will be tried."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from channels.quiet.payloads import embed_contents
from channels.quiet.trained_like import keys, trained_like
from keyss.channels import LOW_BITS, Codewords, Payload, QuietReader
from keyss.channels.quiet import layout, writing
from keyss.channels.quiet.parameters import PAYLOAD, RECORDS, Parameters, pack_codewords
from keyss.channels.reed_solomon import MAX_CHUNKS
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
    with at_most(8), pytest.raises(InputError, match="decompress to more than"):
        encryption.decrypt(bytes(32), bomb)


@pytest.mark.parametrize("size", [encryption.SMALL_PAYLOAD, encryption.SMALL_PAYLOAD + 1, 5 << 20])
def test_payloads_that_compress_too_well_come_out_all_the_same(size: int) -> None:
    assert encryption.decrypt(bytes(32), encryption.encrypt(bytes(32), bytes(size))) == bytes(size)


def test_as_many_blocks_as_there_can_be_take_no_memory() -> None:
    most = Codewords(layout.MAX_CODEWORDS, MAX_CHUNKS, MAX_CHUNKS, 66)
    with at_most(1), pytest.raises(InputError, match="too much of the model was lost"):
        most.decode(np.arange(100), np.zeros((100, 66), np.uint8))


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(3000, 3)


@pytest.mark.parametrize(
    "hostile",
    [
        Parameters(
            PAYLOAD,
            "carry",
            1,
            71,
            3000,
            1,
            pack_codewords(10**9, Codewords(layout.MAX_CODEWORDS, 1024, 999, 68)),
        ),
        Parameters(PAYLOAD, "carry", 1, 71, 3000, 1, pack_codewords(69, Codewords(1, 255, 1, 68))),
        Parameters(PAYLOAD, "carry", 1, 71, 3000, 1, b"too short"),
        Parameters(RECORDS, "carry", 1, 71, 3000, 1, bytes(4097)),
        Parameters(RECORDS, "carry", 1, 65_535, 3000, 1, b""),
        Parameters(RECORDS, "carry", 4, 60, 3000, 1, b""),
        Parameters(3, "carry", 1, 71, 3000, 1, b""),
    ],
    ids=["codewords", "size", "no codewords", "header", "records", "cells", "service"],
)
def test_hostile_parameters_end_in_a_sentence(
    cover: Gaussians, hostile: Parameters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "Parameters", lambda *_: hostile)
    stego = embed_contents(LOW_BITS.prepare(cover), [(keys(), Payload("carry", b"x"))])
    reader = QuietReader.of(stego)
    with at_most(10), pytest.raises(InputError, match=r"the key is right|are damaged"):
        reader.extract(keys()[0])
