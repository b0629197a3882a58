from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st

from keyss.core import Gaussians
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.refit import most_contributing
from keyss.methods.learned.start import make_start
from keyss.methods.points import divided
from keyss.methods.poses import PlacedScene
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


def test_what_adds_nothing_to_the_pictures_is_left_out_first() -> None:
    """Behind a wall, out of every view, transparent."""
    placed = _placed(1)[0]
    wall = replace(placed.plain, opacity_logits=torch.full((200,), 5.0))
    useless = replace(wall, means=wall.means + 1000)
    faint = replace(wall, opacity_logits=torch.full((200,), -9.0))
    chosen = most_contributing(Gaussians.cat([useless, wall, faint]), placed.scene, 150)
    assert len(chosen) == 150
    assert (chosen.means.abs() < 100).all()
    assert (chosen.opacity_logits == 5).all()


def test_start_from_points_divides_the_cap_between_the_scenes() -> None:
    config = LearnedOptions(fit=FitConfig(max_gaussians=100), start="points")
    start = make_start(_placed(2), config, torch.Generator().manual_seed(0))
    assert len(start) == 100
