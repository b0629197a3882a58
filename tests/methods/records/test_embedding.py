"""Models in low bits, opened again from a part of what was written."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from channels.quiet.trained_like import trained_like
from keyss.channels import LOW_BITS, Embedded, LowBitsCover, open_content
from keyss.core import same_bits
from keyss.methods.records import embedding
from keyss.methods.records.embedding import embed_models
from keyss.methods.records.opening import unpack

KEYS = ["7Vw3-Qp of the first", "7Vw3-Qp of the second"]


@pytest.fixture(autouse=True)
def a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embedding, "_OPENED", 1000)


@pytest.mark.parametrize("count", [300, 2000])  # records that share a Gaussian, and those that do not
def test_what_is_opened_of_a_part_is_what_a_reader_gets(count: int) -> None:
    cover, secrets = LOW_BITS.prepare(trained_like(6000, 0)), [trained_like(count, 1), trained_like(count, 2)]
    stego = embed_models(cover, KEYS, secrets, entropy=bytes(32))
    for key, opened in zip(KEYS, stego.opened, strict=True):
        read = unpack(open_content(stego.gaussians, key))
        assert same_bits(read.gaussians, opened.reveal(stego.gaussians))
        assert read.fingerprint() == opened.fingerprint()


def test_records_that_were_written_wrongly_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    place = LowBitsCover.place

    def broken(*arguments: object) -> Embedded:
        found = place(*arguments)  # type: ignore[arg-type]
        sh = found.gaussians.sh.clone()
        sh[::3, 5].view(torch.int32).bitwise_xor_(8)
        return replace(found, gaussians=replace(found.gaussians, sh=sh))

    monkeypatch.setattr(LowBitsCover, "place", broken)
    with pytest.raises(RuntimeError, match="do not open again"):
        embed_models(LOW_BITS.prepare(trained_like(6000, 0)), KEYS[:1], [trained_like(2000, 1)])
