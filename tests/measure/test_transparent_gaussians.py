"""Transparent Gaussians of a published model, and what they show to who knows how this program hides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu, spearmanr

import keyss
from keyss.channels.low_bits.bits import identities
from keyss.core import Gaussians, Scene
from keyss.core.gaussians import DRAWN_OPACITY
from keyss.methods.learned.attacks import known_remaps
from methods.learned.hiding import hide_scenes
from methods.learned.test_joint import CONFIG, _psnr, _scenes
from tiny_scenes import random_gaussians, tiny_scene


def _without_a_key(stego: Gaussians) -> Gaussians:
    """What the program's source alone tells of the first secret."""
    return known_remaps(stego, 1)["secret 1"]


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = _scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


def _file(pair: tuple[list[Scene], list[Gaussians]], iterations: int, sidecar: bool) -> Gaussians:
    fit = replace(CONFIG.fit, iterations=iterations, max_gaussians=2000)
    return hide_scenes(pair[0], ["a key"], replace(CONFIG, fit=fit), plains=pair[1], sidecar=sidecar).stego


def test_with_a_sidecar_they_show_the_secret_without_a_key(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """A limit: what is to survive rounding is not encrypted. It shows that the test below can fail."""
    scenes, models = pair
    config = replace(CONFIG, fit=replace(CONFIG.fit, iterations=20, max_gaussians=2000))
    hidden = hide_scenes(scenes, ["a key"], config, plains=models, sidecar=True)
    back = hidden.secrets[0].frame.inverse()
    shown, cover = (back.apply_gaussians(each) for each in (_without_a_key(hidden.stego), hidden.stego))
    assert _psnr(shown, scenes[1]) > _psnr(cover, scenes[1]) + 20
    assert int((hidden.stego.opacities < DRAWN_OPACITY).sum()) > 100


def test_without_one_there_are_none(pair: tuple[list[Scene], list[Gaussians]]) -> None:
    stego = _file(pair, 20, sidecar=False)
    assert len(stego) <= len(pair[1][0])
    assert float(stego.opacities.min()) >= CONFIG.fit.prune_opacity
    assert (_without_a_key(stego).opacities < DRAWN_OPACITY).all()


def test_carrying_adds_no_transparent_gaussians() -> None:
    cover, secret = random_gaussians(1500, seed=0), random_gaussians(200, seed=2)
    carried = keyss.hide(cover, [keyss.Secret(secret, "a key")], method="carry").stego
    assert (_without_a_key(carried).opacities < 1 / 255).all()


def test_rows_are_the_covers_in_its_own_order(pair: tuple[list[Scene], list[Gaussians]]) -> None:
    """Any other order would be told from a fit's, in which what came later stands later."""
    stego, plain = _file(pair, 2, sidecar=False), pair[1][0]
    own = torch.cdist(stego.sh.flatten(1), plain.sh.flatten(1)).argmin(1)
    assert (own.diff() > 0).all()


def test_with_a_sidecar_the_order_of_the_rows_says_nothing(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """Neither which Gaussians are the secret's, nor their order in its plain model."""
    stego, models = _file(pair, 2, sidecar=True), pair[1]
    transparent = (stego.opacities < DRAWN_OPACITY).numpy()
    assert 100 < transparent.sum() < 300
    rows = np.arange(len(stego))
    assert mannwhitneyu(rows[transparent], rows[~transparent]).pvalue > 1e-3
    # Training hardly changes harmonics in two steps: each hidden Gaussian knows its own in the plain model.
    hidden = stego.sh[torch.from_numpy(transparent)].flatten(1)
    own = torch.cdist(hidden, models[1].sh.flatten(1)).argmin(1).numpy()
    assert len(set(own)) > 50
    assert spearmanr(np.arange(len(own)), own).pvalue > 1e-3


def test_what_the_cover_becomes_does_not_depend_on_the_secret_or_the_key(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """But for low bits: whoever asks what the file says of the secret asks of those only."""
    scenes, models = pair
    config = replace(CONFIG, fit=replace(CONFIG.fit, iterations=30, max_gaussians=2000))
    others = [scenes[0], tiny_scene(5, views=11, distance=3.0)]
    one = hide_scenes(scenes, ["a key"], config, plains=models).stego
    two = hide_scenes(others, ["k"], config, plains=[models[0], random_gaussians(900, seed=5)]).stego
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.sh[:, 0], two.sh[:, 0])
    assert [row.tobytes() for row in identities(one)] == [row.tobytes() for row in identities(two)]
    assert not torch.equal(one.quats, two.quats)
