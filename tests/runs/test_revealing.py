from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from keyss.core import Gaussians
from keyss.methods import Recovered
from keyss.runs.revealing import Revealed, check_model, check_secret, loss_warnings
from tiny_scenes import random_gaussians


@pytest.mark.parametrize(
    ("recovered", "expected"),
    [
        (Recovered(100, 100, (12, 12)), []),
        (Recovered(100, 100, (9, 12)), ["3 of 12 shards of the secret's payload were lost, and restored"]),
        (Recovered(75, 100, (9, 12)), ["75 of 100 Gaussians of the secret were found"]),
        (Recovered(120, 100), ["120 of 100 Gaussians of the secret were found"]),
    ],
)
def test_loss_warnings(recovered: Recovered, expected: list[str]) -> None:
    warnings = loss_warnings(recovered)
    assert len(warnings) == len(expected)
    for warning, start in zip(warnings, expected, strict=True):
        assert warning.startswith(start)
    assert check_secret(Revealed(None, recovered, tuple(warnings))).problems == tuple(warnings)


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
