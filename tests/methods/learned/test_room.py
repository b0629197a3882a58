"""Whether there is room in low bits is known before anything is trained."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import keyss
from channels.low_bits.trained_like import trained_like
from keyss import Gaussians, LearnedOptions, Secret
from keyss.channels.appended import is_appended
from keyss.channels.low_bits.usable import usable_carriers
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.fitting.config import FitConfig
from keyss.measure.hiding import mean_psnr
from keyss.methods import registry
from keyss.methods.base import SceneInput
from keyss.methods.learned import publication
from keyss.methods.learned.options import training_options
from keyss.methods.learned.room import of_degree, prepared_cover, record_degree, secret_sizes
from keyss.rendering.orbit import scene_of_model
from methods.learned.hiding import hide_scenes, open_secret
from tiny_scenes import random_gaussians, tiny_scene

KEY = "a key of many characters: 93hXmQ2"


def _steps(values: torch.Tensor) -> torch.Tensor:
    return (values * 64).round() / 64


def _prepare(options: LearnedOptions, *models: Gaussians) -> LearnedOptions:
    found: LearnedOptions = registry.get("learned").prepare(
        [SceneInput(each, False) for each in models], options
    )
    return found


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_quantised_covers_get_random_low_bits(degree: int) -> None:
    model = trained_like(2000, sh_degree=degree).map(_steps)
    assert usable_carriers(model).mean() < 0.1
    wanted = max(1, degree)
    prepared = prepared_cover(of_degree(model, wanted, os.urandom(32)), os.urandom(32))
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
        _prepare(LearnedOptions(), cover, secret)
    assert _prepare(LearnedOptions(sh_degree=1), cover, secret).fit.sh_degree == 1
    assert _prepare(LearnedOptions(publish="any"), cover, secret).fit.sh_degree == 0


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
        _prepare(LearnedOptions(), grey, grey)
    _prepare(LearnedOptions(), trained_like(8000), grey)
    _prepare(LearnedOptions(publish="any"), grey, grey)


def test_decoders_are_appended_rather_than_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Started from points, it is not known before how many carriers there will be."""

    class Unusable:
        prepare: Callable[[Gaussians], None]

        def __init__(self) -> None:
            def refuse(model: Gaussians) -> None:
                raise InputError("no low bits")

            self.prepare = refuse

    monkeypatch.setattr(publication, "LOW_BITS", Unusable())
    scenes = [tiny_scene(seed) for seed in range(2)]
    fit = FitConfig(iterations=2, max_gaussians=6000)
    options = LearnedOptions(start="points", hidden=(8, 8), branch=8, fit=fit)
    plains = [random_gaussians(seed=seed) for seed in range(2)]
    hidden = hide_scenes(scenes, [KEY], options, plains=plains)
    assert is_appended(hidden.stego).any()
    revealed = open_secret(hidden.stego, KEY).reveal(hidden.stego)
    assert np.isfinite(revealed.means.numpy()).all()


@pytest.mark.parametrize("quantised", [False, True])
def test_the_cover_keeps_all_but_low_bits_unless_they_are_not_random(quantised: bool) -> None:
    cover, secret = trained_like(2000), trained_like(900, 1)
    cover = cover.map(_steps) if quantised else cover
    options = LearnedOptions(iterations=2)
    result = keyss.hide(cover, [Secret(secret, KEY)], method=options, width=24, min_psnr=0)
    details = result.metrics.details
    assert ("dithered_cover_psnr_against_the_one_before" in details) == quantised
    assert [len(keyss.reveal(result.stego, KEY))] == details["gaussians_before_pruning"]
    assert torch.equal(result.stego.means, cover.means)
    if not quantised:
        for name in ("quats", "log_scales", "opacity_logits", "sh"):
            ours, theirs = (getattr(each, name).view(torch.int32) for each in (result.stego, cover))
            assert int((ours ^ theirs).max()) < 1 << 13
            assert int((ours ^ theirs).min()) >= 0  # neither sign nor exponent


def test_secrets_get_what_fits_and_no_more_than_they_have() -> None:
    options = training_options(LearnedOptions())
    first, second = secret_sizes([1500, 9000], 2000, 1800, options)
    # Two records to a Gaussian that carries something, less headers.
    assert 2000 < first + second < 3600
    assert first <= 1500
    assert secret_sizes([1500, 9000], 2000, 1800, replace(options, secret_share=0.2)) == [400, 400]


def test_zeros_that_training_left_stay() -> None:
    """Small random numbers in their place would be known by their size."""
    model = trained_like(2000)
    model.sh[:150, 4:] = 0
    prepared = prepared_cover(of_degree(model, 3, os.urandom(32)), os.urandom(32))
    assert torch.equal(prepared.cover.sh, model.sh)


def test_secrets_that_get_less_because_of_others_are_warned_of() -> None:
    cover, large, small = trained_like(4000), trained_like(4000, 1), trained_like(900, 2)
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        _prepare(LearnedOptions(), cover, large, small)
    _prepare(LearnedOptions(), cover, small, small)


@pytest.mark.parametrize(("degree", "expected"), [(0, None), (1, 0), (2, 2), (3, 3)])
def test_harmonics_that_a_record_has_room_for(degree: int, expected: int | None) -> None:
    assert record_degree(degree) == expected


def test_fewer_harmonics_than_a_secret_has_are_said() -> None:
    cover, secret = random_gaussians(2000, sh_degree=1), random_gaussians(900, seed=1, sh_degree=3)
    options = LearnedOptions(iterations=2)
    result = keyss.hide(cover, [Secret(secret, KEY)], method=options, width=24, min_psnr=0)
    assert result.stego.sh_degree == 1
    (psnr,) = result.metrics.details["psnr_of_fewer_harmonics"]
    assert 10 < psnr < 60
