"""Codes from strangers: typed errors in bounded time, whatever they hold."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from channels.quiet.coded import FORMATS, codes_of, opened, written
from files.formats.examples import KINDS, random_codes
from keyss.channels import CodesCover, Payload
from keyss.channels.quiet import writing
from keyss.channels.quiet.parameters import PAYLOAD, Parameters
from keyss.core import InputError, UsageError, WrongKeyError
from keyss.methods.records.opening import unpack

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


@pytest.mark.parametrize(("count", "size"), [(1, 0), (10**6, 120), (1, 129), (2**32 - 1, 2**16 - 1)])
def test_parameters_that_name_more_than_there_is(
    count: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = Parameters(PAYLOAD, "carry", 1, size, 2500, count, b"")
    monkeypatch.setattr(writing, "Parameters", lambda *_: hostile)
    file = written(CodesCover.of(codes_of(".spz", 2500)), b"data")
    with pytest.raises(InputError, match="exceed the file"):
        opened(file)


def test_payloads_that_are_no_models() -> None:
    for data in (b"", b"\0" * 3, b"\x01\0\0\0", bytes(300), b"\xff" * 300):
        with pytest.raises(InputError, match="damaged"):
            unpack(Payload("carry", data))
