from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.hiding.config import HideConfig
from keyss.hiding.start import _shares, make_start
from keyss.hiding.targets import PlacedScene
from tiny_scenes import random_gaussians, tiny_scene


@given(
    st.lists(st.tuples(st.integers(0, 50), st.floats(0.1, 3)), min_size=1, max_size=5), st.integers(0, 300)
)
def test_shares_use_all_there_is_and_no_more(parts: list[tuple[int, float]], total: int) -> None:
    available, weights = [n for n, _ in parts], [w for _, w in parts]
    shares = _shares(available, weights, total)
    assert all(0 <= share <= n for share, n in zip(shares, available, strict=True))
    assert sum(shares) == min(total, sum(available))


def test_shares_follow_the_weights() -> None:
    assert _shares([1000, 1000], [1, 0.5], 300) == [200, 100]


def _placed(count: int) -> list[PlacedScene]:
    return [
        PlacedScene.of(tiny_scene(seed), random_gaussians(seed=seed), Similarity.identity())
        for seed in range(count)
    ]


def test_warm_start_shows_the_cover_and_hides_the_secrets() -> None:
    config = HideConfig(fit=FitConfig(max_gaussians=330))
    start = make_start(_placed(3), config, torch.Generator())
    assert len(start.gaussians) == 330
    assert start.opacity_logits is not None
    first, second = (logits.sigmoid() for logits in start.opacity_logits)
    shown = start.gaussians.opacities > 1 / 255
    # Every Gaussian is visible in one scene at most, and the secrets' are not drawn in the cover.
    assert int(shown.sum()) < 330 / 2
    assert not (shown & (first > 0.01)).any()
    assert not ((first > 0.01) & (second > 0.01)).any()
    assert float(first.max()) > 0.5
    assert float(second.max()) > 0.5


def test_start_from_points_divides_the_cap_between_the_scenes() -> None:
    config = HideConfig(fit=FitConfig(max_gaussians=100), start="points")
    start = make_start(_placed(2), config, torch.Generator().manual_seed(0))
    assert len(start.gaussians) == 100
    assert start.opacity_logits is None
