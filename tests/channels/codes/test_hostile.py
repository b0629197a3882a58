"""Codes from strangers: typed errors in bounded time, whatever they hold."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from channels.codes.published import FORMATS, codes_of, opened, written
from files.formats.examples import KINDS, random_codes
from keyss.channels import CodesCover, Payload
from keyss.channels.codes.layout import Header, Zones, find_header
from keyss.core import InputError, UsageError, WrongKeyError
from keyss.keys import DerivedKey
from keyss.methods.records.opening import unpack

KEY = DerivedKey(bytes(32))
EVERY = pytest.mark.parametrize("suffix", FORMATS)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS))
def test_random_codes_open_nothing(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    codes = random_codes(kind, rng, int(rng.integers(1, 4000)), 3)
    with pytest.raises(WrongKeyError):
        opened(codes)
    try:
        file = written(CodesCover.of(codes), b"data")
    except UsageError:  # no room, or none but for the headers: all fields are left alone
        return
    assert opened(file) == b"data"


@EVERY
def test_mutated_files_open_or_are_refused(suffix: str) -> None:
    rng = np.random.default_rng(0)
    cover = CodesCover.of(codes_of(suffix, 2500))
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


@pytest.mark.parametrize(
    "header",
    [Header(9, 0, 0), Header(9, 0, 2**32 - 1), Header(9, 2**32 - 1, 1), Header(0, 0, 1), Header(1025, 0, 1)],
)
def test_a_header_that_names_more_than_there_is(header: Header) -> None:
    room = Zones(20_000)
    zone = bytes(16) + header.encrypt(KEY, 0) + bytes(28 * (room.slots - 1))
    with pytest.raises(InputError, match="exceed the file"):
        find_header(zone, KEY, room)


def test_payloads_that_are_no_models() -> None:
    for data in (b"", b"\0" * 3, b"\x01\0\0\0", bytes(300), b"\xff" * 300):
        with pytest.raises(InputError, match="damaged"):
            unpack(Payload("carry", data))
