"""Whether there is room in low bits is known before anything is trained."""

from __future__ import annotations

import os

import pytest
import torch

import keyss
from channels.low_bits.trained_like import trained_like
from keyss import CarryOptions, Gaussians, Secret
from keyss.channels import usable_carriers
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.measure.hiding import mean_psnr
from keyss.methods import RecordRoom, Source, Wanted, record_degree, registry
from keyss.methods.carry.room import of_degree
from keyss.rendering.orbit import scene_of_model
from tiny_scenes import random_gaussians

KEY = "a key of many characters: 93hXmQ2"


def _steps(values: torch.Tensor) -> torch.Tensor:
    return (values * 64).round() / 64


def _prepare(options: CarryOptions, *models: Gaussians) -> CarryOptions:
    found: CarryOptions = registry.get("carry").prepare([Source(each, False) for each in models], options)
    return found


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_quantised_covers_get_random_low_bits_when_asked_for(degree: int) -> None:
    model, secret = trained_like(2000, sh_degree=degree).map(_steps), trained_like(300, 1, 0)
    assert usable_carriers(model).mean() < 0.1
    wanted = max(1, degree)
    asked = f"`{'' if degree else 'sh_degree=1, '}dither=True` makes room"
    with pytest.raises(UsageError if degree == 0 else InputError, match=f"{asked}.*`publish=.any.`"):
        _prepare(CarryOptions(), model, secret)
    options = _prepare(CarryOptions(dither=True, sh_degree=wanted), model, secret)
    prepared = RecordRoom.of(model, options).prepared
    assert prepared is not None
    assert prepared.cover.sh_degree == wanted
    assert prepared.usable.mean() > 0.8
    assert torch.equal(prepared.cover.means, model.means)


def test_new_harmonics_cannot_be_seen() -> None:
    model = random_gaussians(300, sh_degree=0)
    scene = scene_of_model(model, "m", size=48)
    assert mean_psnr(of_degree(model, 3, bytes(32)), scene.test, scene.background) > 55


def test_a_cover_without_harmonics_is_refused_with_ways_that_are_accepted() -> None:
    cover, secret = trained_like(4000, sh_degree=0), trained_like(2000, 1, 2)
    with pytest.raises(UsageError, match=r"degree 0 .*`sh_degree=1` .*0\.4 MB .*0\.3.*`publish=.any.`"):
        _prepare(CarryOptions(), cover, secret)
    assert _prepare(CarryOptions(sh_degree=1), cover, secret).fit.sh_degree == 1
    assert _prepare(CarryOptions(publish="any"), cover, secret).fit.sh_degree == 0


def test_what_training_will_not_make_random_is_refused() -> None:
    """Round Gaussians of one colour: equal numbers, in which anything would be seen."""
    model = trained_like(4000)
    grey = Gaussians(
        model.means,
        model.quats,
        model.log_scales[:, :1].repeat(1, 3),
        model.opacity_logits,
        model.sh[:, :, :1].repeat(1, 1, 3),
    )
    with pytest.raises(InputError, match=r"random low bits.*`publish=.any.`"):
        _prepare(CarryOptions(), grey, grey)
    _prepare(CarryOptions(), trained_like(8000), grey)
    _prepare(CarryOptions(publish="any"), grey, grey)


@pytest.mark.parametrize("quantised", [False, True])
def test_the_cover_keeps_all_but_low_bits_unless_they_are_not_random(quantised: bool) -> None:
    cover, secret = trained_like(2000), trained_like(900, 1)
    cover = cover.map(_steps) if quantised else cover
    options = CarryOptions(dither=quantised)
    result = keyss.hide(cover, [Secret(secret, KEY)], method=options, width=24, min_psnr=0)
    details = result.metrics.details
    assert ("dithered_cover_psnr_against_the_one_before" in details) == quantised
    assert [len(keyss.reveal(result.stego, KEY).gaussians)] == details["gaussians_before_pruning"]
    assert torch.equal(result.stego.means, cover.means)
    if not quantised:
        for name in ("quats", "log_scales", "opacity_logits", "sh"):
            ours, theirs = (getattr(each, name).view(torch.int32) for each in (result.stego, cover))
            assert int((ours ^ theirs).max()) < 1 << 13
            assert int((ours ^ theirs).min()) >= 0  # neither sign nor exponent


def test_secrets_get_what_fits_and_no_more_than_they_have() -> None:
    (first, _), (second, _) = RecordRoom(2000, 3, 1800).sizes([Wanted(1500, 3), Wanted(9000, 3)])
    # Two records to a Gaussian that carries something, less headers.
    assert 2000 < first + second < 3600
    assert first <= 1500


def test_zeros_that_training_left_stay() -> None:
    """Small random numbers in their place would be known by their size."""
    model = trained_like(2000)
    model.sh[:150, 4:] = 0
    assert torch.equal(of_degree(model, 3, os.urandom(32)).sh, model.sh)
    assert _prepare(CarryOptions(), model, trained_like(300, 1)).refits == (0,)


def test_secrets_that_get_less_because_of_others_are_warned_of() -> None:
    cover, large, small = trained_like(4000), trained_like(8000, 1), trained_like(900, 2)
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _prepare(CarryOptions(), cover, large, small)
    _prepare(CarryOptions(), cover, small, small)


@pytest.mark.parametrize(("degree", "expected"), [(0, None), (1, 0), (2, 2), (3, 3)])
def test_harmonics_that_a_record_has_room_for(degree: int, expected: int | None) -> None:
    assert record_degree(degree) == expected


def test_fewer_harmonics_than_a_secret_has_are_said() -> None:
    cover, secret = random_gaussians(2000, sh_degree=1), random_gaussians(900, seed=1, sh_degree=3)
    options = CarryOptions(iterations=2)
    result = keyss.hide(cover, [Secret(secret, KEY)], method=options, width=24, min_psnr=0)
    assert result.stego.sh_degree == 1
    (psnr,) = result.metrics.details["psnr_of_fewer_harmonics"]
    assert 10 < psnr < 60
