"""Known answers: files that were written once open ever after, and damaged ones fail for the reason named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from keyss.channels import LOW_BITS, Records
from keyss.core import Gaussians, WrongKeyError
from keyss.files import read_model

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[1] / "vectors"
CARRIED = json.loads((FOLDER / "carried.json").read_text())


def _moved(stego: Gaussians) -> Gaussians:
    return replace(stego, means=stego.means + 0.01)


def _quantised(stego: Gaussians) -> Gaussians:
    return stego.map(lambda values: values.half().float())


@pytest.mark.parametrize("change", [_moved, _quantised, lambda stego: stego.with_sh_degree(2)])
def test_stego_models_that_must_fail(change: Callable[[Gaussians], Gaussians]) -> None:
    with pytest.raises(WrongKeyError, match="opens nothing"):
        LOW_BITS.reader(change(read_model(FOLDER / "carried.ply"))).open(CARRIED["key"])


def test_what_is_left_of_a_stego_model_comes_out() -> None:
    stego = read_model(FOLDER / "carried.ply")
    order = torch.randperm(len(stego), generator=torch.Generator().manual_seed(0))
    content = LOW_BITS.reader(stego[order[:360]]).open(CARRIED["key"])
    assert isinstance(content, Records)
    assert content.method == "carry"
    assert 4 <= len(content.records) <= CARRIED["count"]
