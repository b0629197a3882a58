"""The capacity of low bits is checked before training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from channels.lsb.trained_like import trained_like
from keyss import CarryOptions, FitConfig, Gaussians
from keyss.channels import LOW_BITS, Layout, LowBitsCapacity, Payload, sealed_size
from keyss.channels.appended import appended_channel
from keyss.channels.foreign import EXACT_BYTES
from keyss.core import KeyssWarning, UsageError
from keyss.methods import Context, Prepared, Source, registry
from keyss.methods.carry.carry_method import CarryCapacity
from keyss.rendering import Viewpoints, scene_of_model

KEY = "a key of many characters: 93hXmQ2"


def _prepare(options: CarryOptions, *models: Gaussians) -> Prepared:
    return registry.get("carry").prepare([Source(model, False) for model in models], options)


def _unit(model: Gaussians) -> Gaussians:
    return replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))


@pytest.mark.parametrize(("change", "least"), [(lambda model: model, 1000), (_unit, 300)])
def test_cover_without_harmonics(change: Callable[[Gaussians], Gaussians], least: int) -> None:
    """A secret is pruned to what the low bits of geometry hold."""
    cover, secret = change(trained_like(20_000, sh_degree=0)), trained_like(4000, 1, 2)
    prepared = _prepare(CarryOptions(fine_tune="never", format="ply"), cover, secret)
    sources = [Source(model, False, KEY, scene_of_model(model, "m", size=24)) for model in (cover, secret)]
    context = Context(torch.device("cpu"), entropy=bytes(32))
    stego = registry.get("carry").hide(sources, prepared, context)
    (opened,) = stego.opened
    assert stego.gaussians.sh_degree == prepared.plan.sh_degree == 0
    assert len(opened.reveal(stego.gaussians)) >= prepared.plan.capacity > least


def test_predictable_cover_is_refused() -> None:
    """Round grey Gaussians: training leaves equal numbers, whose changes are visible."""
    model = trained_like(4000)
    grey = Gaussians(
        model.means,
        model.quats,
        model.log_scales[:, :1].repeat(1, 3),
        model.opacity_logits,
        model.sh[:, :, :1].repeat(1, 1, 3),
    )
    for explicit in (CarryOptions(format="ply"), CarryOptions(publish="unchanged")):
        with pytest.raises(UsageError, match=r"random low bits.*`publish=.converted.`"):
            _prepare(explicit, grey, grey)
    with pytest.warns(KeyssWarning, match=r"unchanged.*random low bits"):
        assert _prepare(CarryOptions(), grey, grey).survives
    _prepare(CarryOptions(), trained_like(8000), grey)
    _prepare(CarryOptions(publish="converted"), grey, grey)


@pytest.mark.parametrize("gaussians", [600, 1600, 5300, 27_000])
@pytest.mark.parametrize("secrets", [1, 2, 3, 5, 8])
def test_shares_fit(gaussians: int, secrets: int) -> None:
    """Incompressible payloads of the sizes that secrets may have, whatever they need."""
    cells = LowBitsCapacity.of(gaussians, Layout(3))
    capacity, random = cells.for_payloads(), np.random.default_rng(0)
    for _ in range(20):
        needed = random.integers(1, capacity.bytes + 2, secrets).tolist()
        limits = capacity.limits(needed)
        if min(limits):
            cells.plan([sealed_size(Payload("carry", random.bytes(limit)), EXACT_BYTES) for limit in limits])


def test_pruning_for_other_secrets_warns() -> None:
    """Alone it would stay whole; pruned to a third, its payload fits into a half."""
    cover, models = trained_like(4000), [trained_like(count, 1, 1) for count in (4000, 200, 200)]
    capacity = CarryCapacity.of(LOW_BITS, cover, FitConfig())
    views = [Viewpoints.around(model) for model in models]
    (alone,) = capacity.prune(models[:1], views[:1])
    assert len(alone) == 4000
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        assert len(capacity.prune(models, views)[0]) < 4000


def test_secret_too_large_to_append(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(appended_channel, "MAX_BYTES", 20_000)
    with pytest.raises(UsageError, match=r"bytes, and [0-9,]+ can be appended; fewer Gaussians"):
        _prepare(CarryOptions(publish="converted"), trained_like(500), trained_like(4000, 1))
    _prepare(CarryOptions(publish="converted"), trained_like(500), trained_like(600, 1))
