"""`info` on models."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from keyss import info
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.runs import ModelInfo
from tiny_scenes import random_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("suffix", ["ply", "PLY", "compressed.ply", "glb"])
def test_info_agrees_with_the_model(tmp_path: Path, suffix: str, degree: int) -> None:
    """A plain .ply is read without torch, other formats by `read_model`, which is the oracle."""
    path = tmp_path / f"model.{suffix}"
    made = random_gaussians(500, sh_degree=degree)
    logits = made.opacity_logits.clone()
    logits[:5] = torch.tensor([torch.inf, -torch.inf, -16.0, -2.95, -2.94])  # 0.05 lies between the last two
    write_model(path, Gaussians(made.means, made.quats, made.log_scales, logits, made.sh))
    model, found = read_model(path), info(path)
    assert isinstance(found, ModelInfo)
    assert (found.gaussians, found.sh_degree) == (500, degree) == (len(model), model.sh_degree)
    assert found.bytes == path.stat().st_size
    for corner, meant in zip(found.bounding_box, (model.means.amin(0), model.means.amax(0)), strict=True):
        assert corner == tuple(round(float(each), 4) for each in meant)
    assert found.nearly_transparent == round(float((model.opacities < 0.05).float().mean()), 4)
