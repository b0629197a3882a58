"""The frozen model in `tests/vectors`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from keyss.core import Gaussians, WrongKeyError
from keyss.files import read_model
from methods.carry.carried import extract

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
VECTOR = json.loads((FOLDER / "carried.json").read_text())
STEGO = read_model(FOLDER / "carried.ply")


def test_known_answer() -> None:
    carried = extract(STEGO, VECTOR["key"])
    assert (carried.count, carried.bits) == (VECTOR["count"], VECTOR["bits"])
    found = carried.gaussians[carried.gaussians.means[:, 0].argsort()]
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        values = getattr(found, name)
        torch.testing.assert_close(values, torch.tensor(VECTOR[name]).reshape(values.shape))


def test_wrong_key() -> None:
    with pytest.raises(WrongKeyError):
        extract(STEGO, VECTOR["wrong"])


@pytest.mark.parametrize(
    "change",
    [
        lambda stego: replace(stego, means=stego.means + 0.01),
        lambda stego: stego.map(lambda values: values.half().float()),
        lambda stego: stego.with_sh_degree(2),
    ],
)
def test_modified_models_open_nothing(change: Callable[[Gaussians], Gaussians]) -> None:
    with pytest.raises(WrongKeyError, match="opens nothing"):
        extract(change(STEGO), VECTOR["key"])


def test_pruned_model() -> None:
    order = torch.randperm(len(STEGO), generator=torch.Generator().manual_seed(0))
    carried = extract(STEGO[order[:360]], VECTOR["key"])
    assert 4 <= len(carried.gaussians) <= carried.count == VECTOR["count"]
