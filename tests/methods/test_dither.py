"""New low bits for models that came through a coarser format."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from channels.quiet.trained_like import keys, trained_like
from keyss.channels import LOW_BITS, QuietReader
from keyss.core import Gaussians, UsageError, same_bits
from keyss.methods import dither_model
from methods.carry.carried import embed_derived, extract_derived

ENTROPY = bytes(32)


def _half(values: torch.Tensor) -> torch.Tensor:
    return values.half().float()


def _steps(values: torch.Tensor) -> torch.Tensor:
    return (values * 64).round() / 64


def _added(values: torch.Tensor) -> torch.Tensor:
    return values.clamp(-6, -2) + 4


@pytest.fixture(scope="module")
def model() -> Gaussians:
    return trained_like(4000, seed=3)


@pytest.mark.parametrize("change", [_half, _steps])
def test_quantised_models_can_carry_again_and_would_be_rounded_back(
    model: Gaussians, change: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    coarse = model.map(change)
    with pytest.raises(UsageError, match="low bits"):
        LOW_BITS.prepare(coarse)
    fine = dither_model(coarse, ENTROPY)
    assert LOW_BITS.prepare(fine).usable.mean() > 0.9
    assert torch.equal(fine.means, coarse.means)
    assert torch.equal(fine.sh[:, 0], coarse.sh[:, 0])
    for name in ("quats", "log_scales", "opacity_logits", "sh"):
        before, after = getattr(coarse, name), getattr(fine, name)
        assert (change(after) == before).float().mean() > 0.99, name
    own = keys()
    stego = embed_derived(fine, [(own, model[:1000])])
    assert len(extract_derived(QuietReader.of(stego), own[0]).gaussians) == 1000


def test_an_added_offset_is_noticed_and_dithered(model: Gaussians) -> None:
    moved = Gaussians(model.means, model.quats, _added(model.log_scales), model.opacity_logits, model.sh)
    with pytest.raises(UsageError, match="random low bits"):
        LOW_BITS.prepare(moved)
    fine = dither_model(moved, ENTROPY)
    assert torch.equal(fine.quats, moved.quats)
    assert LOW_BITS.prepare(fine).usable.mean() > 0.5
    assert float((fine.log_scales - moved.log_scales).abs().max()) < 0.01


def test_trained_models_and_properties_of_one_value_stay_as_they_are(model: Gaussians) -> None:
    assert same_bits(dither_model(model, ENTROPY), model)
    flat = model.map(torch.clone)
    flat.sh[:, 9:] = 0
    assert same_bits(dither_model(flat, ENTROPY), flat)
