from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import torch
from hypothesis import given
from hypothesis import strategies as st

from keyss.core import Gaussians
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.opacity_band import DRAWN_LOGIT, hidden_logits, opacity_remap
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.start import divided, make_start
from keyss.methods.learned.targets import PlacedScene
from tiny_scenes import random_gaussians, tiny_scene


@given(
    st.lists(st.tuples(st.integers(0, 50), st.floats(0.1, 3)), min_size=1, max_size=5), st.integers(0, 300)
)
def test_shares_use_all_there_is_and_no_more(parts: list[tuple[int, float]], total: int) -> None:
    available, weights = [n for n, _ in parts], [w for _, w in parts]
    shares = divided(available, weights, total)
    assert all(0 <= share <= n for share, n in zip(shares, available, strict=True))
    assert sum(shares) == min(total, sum(available))


def test_shares_follow_the_weights() -> None:
    assert divided([1000, 1000], [1, 0.5], 300) == [200, 100]


def _placed(count: int) -> list[PlacedScene]:
    return [
        PlacedScene.of(tiny_scene(seed), random_gaussians(seed=seed), Similarity.identity())
        for seed in range(count)
    ]


def test_warm_start_shows_the_cover_and_hides_the_secrets() -> None:
    config = LearnedOptions(fit=FitConfig(max_gaussians=330), sidecar=True)
    start = make_start(_placed(3), config, torch.Generator())
    assert len(start) == 330
    decoded = []
    for secret in range(2):
        decoder = Decoder(DecoderShape())
        decoder.set_remap(*opacity_remap(secret))
        decoded.append(decoder(start, decoder.key.fill_(1)).opacities)
    first, second = decoded
    shown = start.opacities > 1 / 255
    # Every Gaussian is visible in one scene at most, and the secrets' are not drawn in the cover.
    assert int(shown.sum()) < 330 / 2
    assert not (shown & (first > 1 / 255)).any()
    assert not ((first > 1 / 255) & (second > 1 / 255)).any()
    assert float(first.max()) > 0.5
    assert float(second.max()) > 0.5


def test_the_key_brings_back_the_opacities_that_a_warm_start_hides() -> None:
    config = LearnedOptions(fit=FitConfig(max_gaussians=10_000), sidecar=True)
    placed = _placed(3)
    start = make_start(placed, config, torch.Generator())
    for secret in (1, 2):
        decoder = Decoder(DecoderShape())
        decoder.set_remap(*opacity_remap(secret - 1))
        revealed = decoder(start, decoder.key.fill_(1))
        own = slice(200 * secret, 200 * (secret + 1))  # nothing had to be left out
        torch.testing.assert_close(
            revealed.opacity_logits[own], placed[secret].plain.opacity_logits, atol=1e-4, rtol=0
        )


def test_bands_of_secrets_do_not_touch_each_other_or_what_is_drawn() -> None:
    bands = []
    for secret in range(6):
        decoder = Decoder(DecoderShape())
        decoder.set_remap(*opacity_remap(secret))
        bands.append(decoder.band)
        extremes = hidden_logits(torch.tensor([-100.0, 100.0]), secret)
        assert decoder.band.outer_low < extremes[0] < extremes[1] < decoder.band.outer_high
    assert bands[0].outer_high < DRAWN_LOGIT
    assert all(below.outer_high < above.outer_low for above, below in pairwise(bands))


def test_what_adds_nothing_to_the_pictures_is_left_out_first() -> None:
    """Behind a wall, out of every view, transparent."""
    placed = _placed(1)[0]
    wall = replace(placed.plain, opacity_logits=torch.full((200,), 5.0))
    useless = replace(wall, means=wall.means + 1000)
    faint = replace(wall, opacity_logits=torch.full((200,), -9.0))
    both = PlacedScene.of(placed.scene, Gaussians.cat([useless, wall, faint]), Similarity.identity())
    config = LearnedOptions(fit=FitConfig(max_gaussians=150), sidecar=True)
    start = make_start([both], config, torch.Generator())
    assert (start.means.abs() < 100).all()
    assert (start.opacity_logits == 5).all()


def test_start_from_points_divides_the_cap_between_the_scenes() -> None:
    config = LearnedOptions(fit=FitConfig(max_gaussians=100), start="points", decoder="network")
    start = make_start(_placed(2), config, torch.Generator().manual_seed(0))
    assert len(start) == 100
