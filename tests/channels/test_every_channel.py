"""What holds in every channel: keys open their own payload, and equal entropy repeats a file."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import pytest

from channels.lsb.quantised import model_of
from channels.lsb.trained_like import trained_like
from keyss.channels import APPENDED, COLOURS, LOW_BITS, Payload, PreparedCover, channel_for, open_payload
from keyss.core import KeyssWarning, UsageError, WrongKeyError
from lab.lifelike import lifelike

CHANNELS: dict[str, Callable[[], PreparedCover]] = {
    "low bits": lambda: LOW_BITS.prepare(trained_like(4500, 5)),
    "quantised": lambda: channel_for("unchanged", format="spz").prepare(model_of()),
    "appended": lambda: APPENDED.prepare(lifelike(3000, 0)),
    "colours": lambda: COLOURS.prepare(lifelike(6000, 0).with_sh_degree(0)),
}
ENTROPY = bytes(range(32))
PAYLOADS = [Payload("file", b"first"), Payload("carry", bytes(6))]


@pytest.fixture(scope="module", params=CHANNELS)
def prepared(request: pytest.FixtureRequest) -> PreparedCover:
    return CHANNELS[request.param]()


def test_two_keys_open_their_own_and_a_third_nothing(prepared: PreparedCover) -> None:
    """Small secrets lie as each would alone, but for appended ones, whose number shows."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stego = prepared.embed(list(zip(("one key", "another"), PAYLOADS, strict=True)), entropy=ENTROPY)
    assert [each.category for each in caught] == [KeyssWarning] * prepared.capacity.grows
    assert [open_payload(stego, key) for key in ("one key", "another")] == PAYLOADS
    with pytest.raises(WrongKeyError):
        open_payload(stego, "a third key")


def test_equal_keys_no_secrets_and_short_entropy_are_refused(prepared: PreparedCover) -> None:
    for secrets in ([], [("a key", payload) for payload in PAYLOADS]):
        with pytest.raises(UsageError, match="same key: expected at least one"):
            prepared.embed(secrets)
    with pytest.raises(ValueError, match="32 bytes"):
        prepared.embed([("a key", PAYLOADS[0])], entropy=b"short")


def test_equal_entropy_repeats_a_file_of_equal_payloads_only(prepared: PreparedCover) -> None:
    files = [prepared.embed([("a key", PAYLOADS[index])], entropy=ENTROPY).digest() for index in (0, 0, 1)]
    assert files[0] == files[1] != files[2]
