"""The frozen model in `tests/vectors`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from keyss.channels import LowBitsReader
from keyss.core import Gaussians, WrongKeyError
from keyss.files import read_model
from methods.carry.carried import extract

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
VECTOR = json.loads((FOLDER / "carried.json").read_text())
STEGO = read_model(FOLDER / "carried.ply")


def test_known_answer() -> None:
    payload = LowBitsReader.of(STEGO).open(VECTOR["key"])
    assert payload.data.hex() == VECTOR["payload"]
    assert len(extract(STEGO, VECTOR["key"]).gaussians) == VECTOR["count"]


def test_wrong_key() -> None:
    with pytest.raises(WrongKeyError):
        extract(STEGO, VECTOR["key"].swapcase())


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
    carried = extract(STEGO[order[:300]], VECTOR["key"])
    assert len(carried.gaussians) == VECTOR["count"]
    left, shards = carried.payload.shards
    assert 0.65 * shards < left < 0.85 * shards
