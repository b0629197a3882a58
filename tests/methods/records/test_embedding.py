"""Models in low bits, opened again from what was written."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from channels.quiet.trained_like import trained_like
from keyss.channels import LOW_BITS, LowBitsCover
from keyss.core import Gaussians
from keyss.methods.records.embedding import embed_models


def test_damaged_records_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    embed = LowBitsCover.embed

    def broken(*arguments: Any, **options: Any) -> Gaussians:
        found = embed(*arguments, **options)
        sh = found.sh.clone()
        sh[::5, 5].view(torch.int32).bitwise_xor_(8)
        return replace(found, sh=sh)

    monkeypatch.setattr(LowBitsCover, "embed", broken)
    with pytest.raises(RuntimeError, match="do not open again"):
        embed_models(
            LOW_BITS.prepare(trained_like(6000, 0)), ["7Vw3-Qp of the first"], [trained_like(2000, 1)]
        )
