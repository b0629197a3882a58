"""A refitted cover shows what the cover shows, and holds no Gaussians that are not its own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from keyss import CarryOptions
from keyss.channels import identities
from keyss.core import Gaussians, Scene
from methods.carry.test_refit import TINY
from methods.hiding import hide_scenes, three_scenes
from tiny_scenes import random_gaussians, tiny_scene


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = three_scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


def _file(pair: tuple[list[Scene], list[Gaussians]], iterations: int) -> Gaussians:
    fit = replace(TINY, iterations=iterations, max_gaussians=2000)
    return hide_scenes(pair[0], ["a key"], CarryOptions(fit=fit, refit="always"), plains=pair[1]).stego


def test_there_are_no_transparent_gaussians_but_its_own(pair: tuple[list[Scene], list[Gaussians]]) -> None:
    stego = _file(pair, 20)
    assert len(stego) <= len(pair[1][0])
    assert float(stego.opacities.min()) >= TINY.prune_opacity


def test_rows_are_the_covers_in_its_own_order(pair: tuple[list[Scene], list[Gaussians]]) -> None:
    """Any other order would be told from a fit's, in which what came later stands later."""
    stego, plain = _file(pair, 2), pair[1][0]
    own = torch.cdist(stego.sh.flatten(1), plain.sh.flatten(1)).argmin(1)
    assert (own.diff() > 0).all()


def test_what_the_cover_becomes_does_not_depend_on_the_secret_or_the_key(
    pair: tuple[list[Scene], list[Gaussians]],
) -> None:
    """But for low bits: whoever asks what the file says of the secret asks of those only."""
    scenes, models = pair
    config = CarryOptions(fit=replace(TINY, iterations=30, max_gaussians=2000), refit="always")
    others = [scenes[0], tiny_scene(5, views=11, distance=3.0)]
    one = hide_scenes(scenes, ["a key"], config, plains=models).stego
    two = hide_scenes(others, ["k"], config, plains=[models[0], random_gaussians(900, seed=5)]).stego
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.sh[:, 0], two.sh[:, 0])
    assert [row.tobytes() for row in identities(one)] == [row.tobytes() for row in identities(two)]
    assert not torch.equal(one.quats, two.quats)
