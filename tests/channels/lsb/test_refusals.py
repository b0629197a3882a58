"""Refusals come before the work that they make useless."""

from __future__ import annotations

import pytest

from channels.lsb.trained_like import trained_like
from keyss.channels import channel_for
from keyss.channels.lsb import usable
from keyss.core import UsageError


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
