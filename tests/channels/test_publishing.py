"""A key opens its secret in whichever channel holds it."""

from __future__ import annotations

import warnings

import pytest

from channels.lsb.trained_like import trained_like
from keyss.channels import APPENDED, LOW_BITS, Channel, Payload, open_payload
from keyss.core import Gaussians, KeyssWarning


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
