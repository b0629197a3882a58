"""Selections of Gaussians."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import torch

from keyss.core import Gaussians

COUNT = 7
CHOICES = [
    slice(1, 6, 2),
    slice(0, 0),
    torch.tensor([6, 0, 0, 3]),
    torch.tensor([5, 1], dtype=torch.int32),
    torch.tensor([True, False, True, True, False, False, True]),
    torch.zeros(COUNT, dtype=torch.bool),
    np.array([4, 2]),
]


@pytest.mark.parametrize("chosen", CHOICES, ids=str)
def test_selections_are_those_of_each_tensor(chosen: Any) -> None:
    shapes = ((COUNT, 3), (COUNT, 4), (COUNT, 3), (COUNT,), (COUNT, 4, 3))
    model = Gaussians(*(torch.randn(shape, requires_grad=True) for shape in shapes))
    selection = model[chosen]
    for field in fields(Gaussians):
        every, some = getattr(model, field.name), getattr(selection, field.name)
        assert some.equal(every[chosen])
        if len(selection):
            gradients = [torch.autograd.grad((part**3).sum(), every)[0] for part in (some, every[chosen])]
            assert gradients[0].equal(gradients[1])
