"""A known answer: the learned secret of `tests/vectors` comes out the same, whatever becomes of the code."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import keyss
from keyss.core import WrongKeyError
from keyss.files.ply import read_ply

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
KEY = "correct horse battery staple"
# The low bits of what is published are overwritten: by so much values may differ from what was hidden.
TOLERANCES = {"means": 1e-4, "quats": 1e-3, "log_scales": 2e-2, "opacity_logits": 5e-2, "sh": 1e-3}


def test_a_learned_secret_opens() -> None:
    found, expected = keyss.reveal(FOLDER / "learned.ply", KEY), read_ply(FOLDER / "learned-secret.ply")
    assert len(found) == len(expected)
    for name, tolerance in TOLERANCES.items():
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=tolerance, rtol=0)


def test_to_its_key_only() -> None:
    with pytest.raises(WrongKeyError):
        keyss.reveal(FOLDER / "learned.ply", KEY + " ")
