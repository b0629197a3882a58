"""What strangers may write: typed errors in bounded time and memory, whatever a file holds."""

from __future__ import annotations

import struct
import time
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from channels.lsb.payloads import embed, extract
from channels.lsb.quantised import FORMATS, codes_of, opened, written
from channels.lsb.trained_like import trained_like
from files.formats.examples import KINDS, random_codes
from keyss.channels import Codewords, LowBitsReader, Parameters, QuantisedCover, container
from keyss.channels.lsb.low_bits_capacity import MAX_CODEWORDS
from keyss.channels.reed_solomon import MAX_SHARDS
from keyss.core import Gaussians, InputError, UsageError, WrongKeyError
from keyss.keys import encryption

EVERY = pytest.mark.parametrize("suffix", FORMATS)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS))
def test_random_codes_open_nothing(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    codes = random_codes(kind, rng, int(rng.integers(1, 4000)), 3)
    with pytest.raises(WrongKeyError):
        opened(codes)
    try:
        file = written(QuantisedCover.of(codes), b"data")
    except UsageError:  # no room, or none but for the headers: all fields are left alone
        return
    assert opened(file) == b"data"


@EVERY
def test_mutated_files_open_or_are_refused(suffix: str) -> None:
    rng = np.random.default_rng(0)
    cover = QuantisedCover.of(codes_of(suffix, 2500))
    file = written(cover, bytes(range(200))).serialise()
    start = time.process_time()  # others may keep the machine busy
    for _ in range(60):
        changed = bytearray(file)
        for at in rng.integers(0, len(file), int(rng.integers(1, 4))):
            changed[at] ^= 1 << int(rng.integers(8))
        if rng.random() < 0.3:
            del changed[int(rng.integers(len(changed))) :]
        try:
            found = opened(FORMATS[suffix].parse(bytes(changed)))
        except (InputError, WrongKeyError):
            continue
        assert found == bytes(range(200))
    assert time.process_time() - start < 60


@pytest.mark.parametrize(("width", "count"), [(0, 1), (120, 0), (120, 2**32 - 1), (129, 1), (48, 120)])
def test_parameters_that_name_more_than_there_is(
    width: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = Parameters(width, count)
    with monkeypatch.context() as patch:
        patch.setattr(container, "Parameters", lambda *_: hostile)
        file = written(QuantisedCover.of(codes_of(".spz", 2500)), b"data")
    with pytest.raises(InputError, match="exceed the file"):
        opened(file)


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
    plain = struct.pack("<I", 1 << 31 | len(packed)) + packed
    bomb = encryption._cipher(bytes(32)).encrypt(encryption._NONCE, plain, b"")
    assert len(bomb) < 64_000
    with at_most(8), pytest.raises(InputError, match="decompress to more than"):
        encryption.decrypt(bytes(32), bomb)


@pytest.mark.parametrize("size", [encryption.SMALL_PAYLOAD, encryption.SMALL_PAYLOAD + 1, 5 << 20])
def test_payloads_that_compress_too_well_come_out_all_the_same(size: int) -> None:
    encrypted = encryption.encrypt(bytes(32), bytes(size), size=1 << 23)
    assert encryption.decrypt(bytes(32), encrypted) == bytes(size)


def test_as_many_blocks_as_there_can_be_take_no_memory() -> None:
    most = Codewords(MAX_CODEWORDS, MAX_SHARDS, MAX_SHARDS, 66)
    with at_most(1), pytest.raises(InputError, match="too much of the model was lost"):
        most.decode(np.arange(100), np.zeros((100, 66), np.uint8))


@pytest.fixture(scope="module")
def cover() -> Gaussians:
    return trained_like(3000, 3)


@pytest.mark.parametrize(
    ("depth", "count", "n", "k"),
    [
        (4, MAX_CODEWORDS, 1024, 999),
        (4, 512, 255, 1),
        (4, MAX_CODEWORDS + 1, 255, 1),
        (4, 2**32 - 1, 2**16 - 1, 1),
        (4, 1, 1025, 1),
        (4, 0, 255, 1),
        (4, 1, 2, 3),
        (4, 1, 255, 0),
        (5, 1, 255, 1),
        (0, 1, 255, 1),
    ],
)
def test_hostile_parameters_end_in_a_sentence(
    cover: Gaussians, depth: int, count: int, n: int, k: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = Parameters(depth, count, n, k)
    with monkeypatch.context() as patch:
        patch.setattr(container, "Parameters", lambda *_: hostile)
        stego = embed(cover, [("a key", b"x")])
    reader = LowBitsReader.of(stego)
    with at_most(10), pytest.raises(InputError, match=r"the key is right|are damaged"):
        reader.open("a key")


@pytest.mark.parametrize("version", [0, 2, 255])
def test_other_versions_end_in_a_sentence(
    cover: Gaussians, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(container, "_VERSION", version)
        stego = embed(cover, [("a key", b"x")])
    with pytest.raises(
        InputError,
        match=f"of version {version}; this program reads version 1: {'update' if version else 'open'}",
    ):
        extract(stego, "a key")
