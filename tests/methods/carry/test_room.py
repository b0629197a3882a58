"""Whether there is room in low bits is known before anything is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import keyss
from channels.quiet.trained_like import trained_like
from keyss import CarryOptions, Gaussians, Secret
from keyss.core import KeyssWarning, UsageError
from keyss.methods import Context, Source, registry
from keyss.rendering import scene_of_model

KEY = "a key of many characters: 93hXmQ2"


def _prepare(options: CarryOptions, *models: Gaussians) -> CarryOptions:
    found: CarryOptions = registry.get("carry").prepare([Source(each, False) for each in models], options)
    return found


def _unit(model: Gaussians) -> Gaussians:
    return replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))


@pytest.mark.parametrize("change", [lambda model: model, _unit])
def test_cover_without_harmonics(
    change: Callable[[Gaussians], Gaussians],
) -> None:
    """What is promised before training holds when it is embedded into."""
    cover, secret = change(trained_like(4000, sh_degree=0)), trained_like(9000, 1, 2)
    with pytest.raises(UsageError, match=r"degree 0 .*no room.*`publish=.any.`") as refusal:
        _prepare(CarryOptions(format="ply"), cover, secret)
    degree = int(str(refusal.value).partition("`sh_degree=")[2][0])
    assert degree == (2 if change is _unit else 1)
    for less in range(degree):
        with pytest.raises(UsageError, match=f"`sh_degree={degree}[`,]"):
            _prepare(CarryOptions(sh_degree=less, format="ply"), cover, secret)
    options = _prepare(CarryOptions(sh_degree=degree, refit="never"), cover, secret)
    sources = [Source(each, False, KEY, scene_of_model(each, "m", size=24)) for each in (cover, secret)]
    planned = registry.get("carry").plan(sources, options)
    context = Context(torch.device("cpu"), entropy=bytes(32))  # as of the plan
    stego = registry.get("carry").hide(sources[0], sources[1:], options, context)
    (opened,) = stego.opened
    assert stego.gaussians.sh_degree == planned.sh_degree == degree
    assert len(opened.reveal(stego.gaussians)) == planned.capacity
    assert planned.capacity > 3000
    assert _prepare(CarryOptions(publish="any"), cover, secret).fit.sh_degree == 0


def test_predictable_cover_is_refused() -> None:
    """Round Gaussians of one colour: equal numbers, in which anything would be seen."""
    model = trained_like(4000)
    grey = Gaussians(
        model.means,
        model.quats,
        model.log_scales[:, :1].repeat(1, 3),
        model.opacity_logits,
        model.sh[:, :, :1].repeat(1, 1, 3),
    )
    with pytest.raises(UsageError, match=r"random low bits.*`publish=.any.`"):
        _prepare(CarryOptions(format="ply"), grey, grey)
    with pytest.warns(KeyssWarning, match=r"whoever inspects.*random low bits"):
        assert _prepare(CarryOptions(), grey, grey).publish == "any"
    _prepare(CarryOptions(), trained_like(8000), grey)
    _prepare(CarryOptions(publish="any"), grey, grey)


def test_only_low_bits_change() -> None:
    cover, secret = trained_like(2000), trained_like(900, 1)
    result = keyss.hide(cover, [Secret(secret, KEY)], width=24, min_psnr=0)
    assert len(keyss.reveal(result.stego, KEY).gaussians) == len(secret)
    assert torch.equal(result.stego.means, cover.means)
    for name in ("quats", "log_scales", "opacity_logits", "sh"):
        ours, theirs = (getattr(each, name).view(torch.int32) for each in (result.stego, cover))
        assert int((ours ^ theirs).max()) < 1 << 13
        assert int((ours ^ theirs).min()) >= 0  # neither sign nor exponent


def test_crowding_warning() -> None:
    cover, large, small = trained_like(4000), trained_like(8000, 1), trained_like(900, 2)
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _prepare(CarryOptions(), cover, large, small)
    _prepare(CarryOptions(), cover, small, small)
