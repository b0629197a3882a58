"""A key opens its payload in whichever channel holds it."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import pytest

from channels.lsb.quantised import model_of
from channels.lsb.trained_like import trained_like
from keyss.channels import (
    APPENDED,
    COLOURS,
    LOW_BITS,
    Channel,
    Payload,
    PreparedCover,
    channel_for,
    open_payload,
)
from keyss.core import Gaussians, KeyssWarning, UsageError, WrongKeyError
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


def test_appended_gaussians_do_not_hide_what_lies_in_low_bits() -> None:
    """A stranger who appends a secret locks out no other key, and does not go unnoticed."""
    stego = LOW_BITS.prepare(trained_like(3000)).embed([("a key", Payload("file", b"in low bits"))])
    more = APPENDED.prepare(stego).embed([("a key of somebody else", Payload("file", b"appended"))])
    with pytest.warns(KeyssWarning, match=r"about [\d,]+ Gaussians were added"):
        assert open_payload(more, "a key").data == b"in low bits"
    assert open_payload(more, "a key of somebody else").data == b"appended"


@pytest.mark.parametrize("channel", [LOW_BITS, APPENDED], ids=["low bits", "appended"])
def test_two_files_of_one_cover_are_told(channel: Channel) -> None:
    """Put into one, they open one of two secrets, and only the copies show it.

    With fixed randomness: of appended secrets, one pair in twenty opens nothing.
    """
    cover = trained_like(3000)
    one, other = (
        channel.prepare(cover).embed([("a key", Payload("file", data))], entropy=data.ljust(32))
        for data in (b"one", b"other")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_payload(one, "a key").data == b"one"
    with pytest.warns(KeyssWarning, match=r"about [\d,]+ Gaussians were added"):
        assert open_payload(Gaussians.cat([one, other]), "a key").data in (b"one", b"other")
