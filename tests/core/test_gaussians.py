"""The representation of a 3DGS model."""

from __future__ import annotations

from tiny_scenes import random_gaussians


def test_a_model_is_described_in_a_line() -> None:
    assert repr(random_gaussians(1500, sh_degree=2)) == "<1,500 Gaussians of SH degree 2 on cpu>"
