from __future__ import annotations

from dataclasses import fields

import torch

from keyss.core import Gaussians
from keyss.runs.revealing import check_model
from tiny_scenes import random_gaussians


def test_duplicates_match_pairwise_comparison() -> None:
    model = random_gaussians(3000, seed=4)
    rows = torch.randint(0, 3000, (900,), generator=torch.Generator().manual_seed(5))
    repeated = Gaussians.cat([model, model[rows], model[rows[:40]]])
    repeated.means[:5] = 0.0
    repeated.means[3000:3900:2] = 0.0
    repeated.means[rows[::2]] = -0.0  # equals 0
    columns = [getattr(repeated, field.name).reshape(len(repeated), -1) for field in fields(repeated)]
    expected = len(repeated) - len(torch.unique(torch.cat(columns, dim=1), dim=0))
    assert check_model(repeated).duplicates == expected > 500
