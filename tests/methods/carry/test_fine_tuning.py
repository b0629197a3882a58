"""When secrets are fine-tuned, for how long, and with which result."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import keyss
from channels.lsb.trained_like import trained_like
from keyss import CarryOptions, FitConfig, Secret
from keyss.channels import gaussian_ids
from keyss.core import Gaussians, KeyssWarning, Scene, UsageError
from keyss.methods import Prepared, Source, Training, most_contributing, registry
from methods.hiding import check_resumes, hide_scenes, psnr_in, three_scenes
from tiny_scenes import random_gaussians, tiny_scene

KEY = "a key of many characters: 93hXmQ2"
FIT = FitConfig(iterations=1000, max_gaussians=4000, seed=0)
TINY = FitConfig(iterations=40, max_gaussians=2600, grow_start=0.2, grow_every=5, evaluate_every=0, seed=0)
KEYS = ("first key", "second key")
PHOTOS = Source(None, photos=True)


def _prepare(options: CarryOptions, *sources: Source) -> Prepared:
    return registry.get("carry").prepare(sources, options)


def _steps(options: CarryOptions, *sources: Source) -> list[int]:
    """Steps of fine-tuning of each secret."""
    return [training.steps for training in _prepare(options, *sources).training[1:]]


def _source(model: Gaussians, photos: bool = False) -> Source:
    return Source(model, photos)


def test_no_fine_tuning_when_secret_fits() -> None:
    cover, secret = trained_like(2500), trained_like(900, 1, 2)
    prepared = _prepare(CarryOptions(), _source(cover), _source(secret))
    assert prepared.training == (Training(), Training())
    assert not prepared.trains
    result = keyss.hide(cover, [Secret(secret, KEY)], views=keyss.ViewOptions(24))
    assert result.metrics.iterations == 0
    revealed = keyss.reveal(result.stego, KEY).gaussians
    assert (len(revealed), revealed.sh_degree) == (900, 2)


def test_fine_tuning_steps() -> None:
    cover, small, large = trained_like(2500), trained_like(300, 1), trained_like(6000, 2)
    options = CarryOptions(fit=FIT)
    assert _steps(options, _source(cover), _source(large)) == [400]
    assert _steps(replace(options, fine_tune="never"), _source(cover), _source(large)) == [0]
    assert _steps(replace(options, fine_tune="always"), _source(cover), _source(small)) == [400]
    assert _steps(options, _source(cover), _source(large, photos=True)) == [1150]
    assert _steps(options, _source(cover), _source(small), _source(large)) == [0, 400]
    assert [fit.iterations for fit in options.fits(3)] == [1000, 2150, 2150]  # those of fine-tuning, too
    asked = options.with_fit(iterations=900)
    assert [fit.iterations for fit in asked.fits(3)] == [900] * 3
    assert _steps(asked, _source(cover), _source(large)) == [900]
    result = keyss.hide(
        cover,
        [Secret(large, KEY)],
        method=options.with_fit(iterations=2),
        views=keyss.ViewOptions(24),
        min_psnr=0,
    )
    assert result.metrics.iterations == 2
    assert (len(keyss.reveal(result.stego, KEY).gaussians),) == result.metrics.secret_gaussians


@pytest.mark.parametrize("photos", [False, True])
def test_hopeless_secrets_are_refused_before_training(photos: bool) -> None:
    """Colours hold about a bit per Gaussian of the cover; nothing is fitted or fine-tuned for them."""
    model = trained_like(4000)
    sources = [Source(None if photos else each, photos) for each in (model, trained_like(4000, 1))]
    colours = CarryOptions(fit=FIT, publish="converted", channel="colours")
    with pytest.raises(UsageError, match=r"4,000 Gaussians would be cut down to about \d\d; `channel="):
        _prepare(colours, *sources)


def test_shared_capacity_warns() -> None:
    cover, large = trained_like(2500), [trained_like(2000, seed) for seed in (1, 2)]
    secrets = [Secret(model, f"{KEY} {number}") for number, model in enumerate(large)]
    with pytest.warns(KeyssWarning, match="can notice that there are other secrets"):
        keyss.hide(
            cover, secrets, method=CarryOptions(fine_tune="never"), views=keyss.ViewOptions(24), min_psnr=0
        )


@pytest.mark.parametrize(("format", "secrets"), [("ply", 3), ("spz", 1)])
def test_fine_tuning_from_photos(format: str, secrets: int) -> None:
    options = CarryOptions(fit=FIT, format=format)  # type: ignore[arg-type]
    prepared = _prepare(options, *[PHOTOS] * (1 + secrets))
    assert [fit.iterations for fit in prepared.fits] == [1000] * (1 + secrets)
    assert prepared.training == (Training(), *[Training(1150)] * secrets)


def test_most_contributing() -> None:
    plain = random_gaussians(seed=0)
    wall = replace(plain, opacity_logits=torch.full((200,), 5.0))
    useless = replace(wall, means=wall.means + 1000)
    faint = replace(wall, opacity_logits=torch.full((200,), -9.0))
    chosen = most_contributing(Gaussians.cat([useless, wall, faint]), tiny_scene(0), 150)
    assert len(chosen) == 150
    assert (chosen.means.abs() < 100).all()
    assert (chosen.opacity_logits == 5).all()


def test_fine_tuning_two_secrets() -> None:
    scenes, models = three_scenes()
    fit = replace(TINY, iterations=30, max_gaussians=3200)
    options = CarryOptions(fit=fit, fine_tune="always")
    many = [random_gaussians(3200, seed=7), *models[1:]]
    hidden = hide_scenes(scenes, KEYS, options, plains=many)
    assert len(hidden.stego) == 3200
    for key, scene in zip(KEYS, scenes[1:], strict=True):
        revealed = registry.open_model(hidden.stego, key).reveal(hidden.stego)
        assert psnr_in(revealed, scene) > 26


def test_resume_fine_tuning(tmp_path: Path) -> None:
    # Published in any format: no cover is refused, however few steps it has trained.
    check_resumes(CarryOptions(fit=TINY, fine_tune="always", publish="converted"), tmp_path, "fine-tuning")


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = three_scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


def test_cover_is_independent_of_secret_and_key(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """Except for low bits."""
    scenes, models = pair
    config = CarryOptions(fit=replace(TINY, iterations=30, max_gaussians=2000), fine_tune="always")
    others = [scenes[0], tiny_scene(5, views=11, distance=3.0)]
    one = hide_scenes(scenes, ["a key"], config, plains=models).stego
    two = hide_scenes(others, ["k"], config, plains=[models[0], random_gaussians(900, seed=5)]).stego
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.sh[:, 0], two.sh[:, 0])
    assert [row.tobytes() for row in gaussian_ids(one)] == [row.tobytes() for row in gaussian_ids(two)]
    assert not torch.equal(one.quats, two.quats)
