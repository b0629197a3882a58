"""A known answer: the carried model of `tests/vectors` comes out the same, whatever becomes of the code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from keyss.core import WrongKeyError
from keyss.files import read_model
from methods.carry.carried import extract

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
VECTOR = json.loads((FOLDER / "carried.json").read_text())
STEGO = read_model(FOLDER / "carried.ply")


def test_a_carried_model_opens() -> None:
    carried = extract(STEGO, VECTOR["key"])
    assert (carried.count, carried.bits) == (VECTOR["count"], VECTOR["bits"])
    found = carried.gaussians[carried.gaussians.means[:, 0].argsort()]
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        values = getattr(found, name)
        torch.testing.assert_close(values, torch.tensor(VECTOR[name]).reshape(values.shape))


def test_to_its_key_only() -> None:
    with pytest.raises(WrongKeyError):
        extract(STEGO, VECTOR["wrong"])
