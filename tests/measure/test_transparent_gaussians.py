"""What is to be seen of a secret without its key, by who knows how this program hides it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu, spearmanr

import keyss
from keyss.core import Gaussians, Scene
from keyss.core.gaussians import DRAWN_OPACITY
from keyss.methods.learned.attacks import known_remaps
from methods.learned.hiding import hide_scenes
from methods.learned.test_joint import CONFIG, _psnr, _scenes
from tiny_scenes import random_gaussians


def _without_a_key(stego: Gaussians) -> Gaussians:
    """What the program's source alone tells of the first secret."""
    return known_remaps(stego, 1)["secret 1"]


def _gain(scenes: list[Scene], models: list[Gaussians], sidecar: bool) -> float:
    """By how many dB that shows the secret better than the cover does, seen from where it lies.

    A person would walk around until it looks right.
    """
    config = replace(CONFIG, fit=replace(CONFIG.fit, iterations=20, max_gaussians=2000))
    hidden = hide_scenes(scenes, ["a key"], config, plains=models, sidecar=sidecar)
    back = hidden.secrets[0].frame.inverse()
    shown, cover = (back.apply_gaussians(each) for each in (_without_a_key(hidden.stego), hidden.stego))
    return _psnr(shown, scenes[1]) - _psnr(cover, scenes[1])


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = _scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


def test_the_transparent_gaussians_of_one_file_say_nothing(pair: tuple[list[Scene], list[Gaussians]]) -> None:
    assert _gain(*pair, sidecar=False) < 5  # any cloud in the middle of the view is that much nearer


def test_with_a_sidecar_they_show_the_secret_without_a_key(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """The control, and a limit: what is to survive rounding cannot be encrypted."""
    assert _gain(*pair, sidecar=True) > 20


def test_what_is_transparent_in_the_cover_is_scrambled_or_left_out(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """Gaussians that left their band in training would lie where the secret is, for everybody to see."""
    scenes, models = pair
    rates = replace(CONFIG.fit, iterations=40, max_gaussians=2000, opacities_rate=2.0)
    hidden = hide_scenes(scenes, ["a key"], replace(CONFIG, fit=rates), plains=models)
    rank_shift = hidden.secrets[0].rank_shift
    assert rank_shift is not None
    logits = hidden.stego.opacity_logits
    encrypted = (logits > rank_shift.band[0]) & (logits < rank_shift.band[1])
    assert 0 < int(encrypted.sum()) <= 200
    assert (encrypted | (hidden.stego.opacities >= 1 / 255)).all()


def test_carrying_adds_no_transparent_gaussians() -> None:
    cover, secret = random_gaussians(1500, seed=0), random_gaussians(200, seed=2)
    carried = keyss.hide(cover, [keyss.Secret(secret, "a key")], method="carry").stego
    assert (_without_a_key(carried).opacities < 1 / 255).all()


@pytest.mark.parametrize("sidecar", [False, True])
def test_the_order_of_the_rows_says_nothing(pair: tuple[list[Scene], list[Gaussians]], sidecar: bool) -> None:
    """Neither which Gaussians are the secret's, nor their order in its plain model."""
    scenes, models = pair
    config = replace(CONFIG, fit=replace(CONFIG.fit, iterations=2, max_gaussians=2000))
    stego = hide_scenes(scenes, ["a key"], config, plains=models, sidecar=sidecar).stego
    transparent = (stego.opacities < DRAWN_OPACITY).numpy()
    assert 100 < transparent.sum() < 300
    rows = np.arange(len(stego))
    assert mannwhitneyu(rows[transparent], rows[~transparent]).pvalue > 1e-3
    # Training hardly changes harmonics in two steps: each hidden Gaussian knows its own in the plain model.
    hidden = stego.sh[torch.from_numpy(transparent)].flatten(1)
    own = torch.cdist(hidden, models[1].sh.flatten(1)).argmin(1).numpy()
    assert len(set(own)) > 50
    assert spearmanr(np.arange(len(own)), own).pvalue > 1e-3
