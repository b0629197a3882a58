"""Refusals come before the work that they make useless."""

from __future__ import annotations

import os
import re

import pytest

from channels.lsb.trained_like import trained_like
from keyss import CarryOptions, Secret, SecretFile, hide
from keyss.channels import channel_for
from keyss.channels.appended import appended_channel
from keyss.channels.lsb import usable
from keyss.core import Gaussians, UsageError
from keyss.methods.carry import capacity


def test_large_covers_without_random_bits_are_refused_by_a_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []

    def counted(gaussians: object, *rest: object) -> object:
        judged.append(len(gaussians))  # type: ignore[arg-type]
        return original(gaussians, *rest)  # type: ignore[arg-type]

    original = usable.Steps
    monkeypatch.setattr(usable, "Steps", counted)
    monkeypatch.setattr(usable, "_LARGE", 5000)
    monkeypatch.setattr(usable, "_SAMPLE", 1000)
    cover = trained_like(6000, 0, 1)
    channel_for("unchanged", "colours", "ply", cover).prepare(cover)  # has random bits
    assert judged == [1000, 6000]
    judged.clear()
    quantised = cover.map(lambda values: values.half().float())
    with pytest.raises(UsageError, match="it was quantised"):
        channel_for("unchanged", "colours", "ply", quantised).prepare(quantised)
    assert judged == [1000]


@pytest.mark.parametrize(("publish", "channel"), [("converted", "colours"), ("unchanged", "appended")])
def test_files_that_no_cover_of_the_size_holds_are_refused_unseen(
    monkeypatch: pytest.MonkeyPatch, publish: str, channel: str
) -> None:
    cover = trained_like(20_000, 0, 1)
    place = channel_for(publish, channel, None, cover)  # type: ignore[arg-type]
    monkeypatch.setattr(place, "prepare", lambda _: pytest.fail("the cover is examined"))
    secret = SecretFile(os.urandom(4_000_000), "7Vw3-Qp: a key for a test", "noise")
    options = CarryOptions(publish=publish, channel=channel)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="a cover of 20,000 Gaussians holds about"):
        hide(cover, [secret], method=options)
    with pytest.raises(pytest.fail.Exception, match="the cover is examined"):  # its zeros compress
        hide(cover, [SecretFile(bytes(1_000_000), secret.key, "zeros")], method=options)


def test_secrets_that_cannot_be_appended_are_refused_by_a_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    def counted(model: Gaussians) -> int:
        sizes.append(len(model))
        return original(model)

    original = capacity.usual_size
    monkeypatch.setattr(capacity, "usual_size", counted)
    monkeypatch.setattr(capacity, "_SAMPLE", 1000)
    secret = trained_like(20_000, 1)
    exact = original(secret)
    with monkeypatch.context() as smaller:
        smaller.setattr(appended_channel, "MAX_BYTES", exact // 2)
        with pytest.raises(UsageError, match="can be appended; fewer Gaussians") as refused:
            hide(trained_like(500, 0), [Secret(secret, "7Vw3-Qp: a key for a test")], publish="converted")
    assert sizes == [1000]
    (told,) = re.findall(r"about ([0-9,]+) bytes", str(refused.value))
    assert 0.8 * exact < int(told.replace(",", "")) < 1.2 * exact
    monkeypatch.setattr(appended_channel, "MAX_BYTES", exact)
    capacity.check_appended(secret)  # may fit
