"""No Gaussian that a view shows is left out, even after a decoder moved it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from keyss.methods.poses import possibly_seen
from keyss.rendering import render_with_meta
from keyss.rendering.orbit import orbit
from tiny_scenes import random_gaussians


@pytest.mark.parametrize("slack", [0.0, 0.5])
def test_what_a_view_shows_may_be_seen_and_what_lies_far_aside_may_not(slack: float) -> None:
    generator = torch.Generator().manual_seed(0)
    model = random_gaussians(400)
    camera = replace(orbit(model, 48, 4)[3], width=24, height=24)  # a corner: much lies outside
    seen = set(possibly_seen(model, camera, slack).tolist())
    assert 0 < len(seen) < len(model)
    for _ in range(5):
        steps = torch.nn.functional.normalize(torch.randn(len(model), 3, generator=generator), dim=1)
        _, meta = render_with_meta(replace(model, means=model.means + slack * steps), camera)
        drawn = (meta["radii"][0] > 0).all(-1).nonzero()[:, 0].tolist()
        assert drawn
        assert seen.issuperset(drawn)
