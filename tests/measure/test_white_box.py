"""The attack by gradient opens what is not encrypted; one secret's decoder does not help towards another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from torch import Tensor

from keyss.core import Gaussians
from keyss.measure import search_embeddings
from keyss.methods import HiddenSecret
from methods.hiding import Hidden, hide_scenes, psnr_in, three_scenes
from methods.keyss.hiding import KEYS, PUBLISHED

RESTARTS = 4


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    scenes, models = three_scenes()
    options = replace(PUBLISHED, hidden=None, branch=None).with_fit(iterations=300)
    return hide_scenes(scenes, KEYS, options, plains=models)


def _decoder(secret: HiddenSecret) -> Callable[[Gaussians, Tensor], Gaussians]:
    return secret.decode


@pytest.fixture(scope="module")
def found(hidden: Hidden) -> list[Tensor]:
    """What the search finds on each secret's decoder."""
    return [search_embeddings(_decoder(secret), hidden.stego, restarts=RESTARTS) for secret in hidden.opened]


def _gain(hidden: Hidden, found: list[Tensor], decoder_of: int, shown: int) -> list[float]:
    """By how many dB the embeddings found on one decoder show a secret better, best score first."""
    scenes, _ = three_scenes()
    owner, target = hidden.opened[decoder_of], hidden.opened[shown]

    def psnr(model: Gaussians) -> float:
        return psnr_in(target.frame.inverse().apply_gaussians(model), scenes[shown + 1])

    return [
        psnr(owner.decode(hidden.stego, embedding)) - psnr(hidden.stego) for embedding in found[decoder_of]
    ]


@pytest.mark.parametrize("secret", [0, 1])
def test_whoever_holds_a_decoder_opens_its_secret_without_the_key(
    hidden: Hidden, found: list[Tensor], secret: int
) -> None:
    """The control: an attack that failed here would show nothing where it fails below.

    The attacker takes what scores best, without knowing the secret.
    """
    assert _gain(hidden, found, secret, secret)[0] > 8


@pytest.mark.parametrize(("owner", "other"), [(0, 1), (1, 0)])
def test_the_decoder_of_one_secret_does_not_show_another(
    hidden: Hidden, found: list[Tensor], owner: int, other: int
) -> None:
    assert max(_gain(hidden, found, owner, other)) < 1
