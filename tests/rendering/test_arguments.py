"""Errors name invalid arguments; the choice of a device."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import pytest
import torch

from keyss.core import BackendError, UsageError
from keyss.rendering import rasterization, resolve_device


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("width", 2**20),
        ("near_plane", 0.0),
        ("near_plane", 1e11),
        ("near_plane", math.nan),
        ("sh_degree", 5),
        ("colors", torch.ones(2, 33)),
        ("colors", torch.ones(2, 0)),
        ("viewmat", torch.full((4, 4), math.nan)),
        ("K", torch.full((3, 3), math.inf)),
        ("K", -torch.eye(3)),
        ("background", torch.tensor([0.0, math.nan, 0.0])),
    ],
)
def test_wrong_values(name: str, value: object) -> None:
    """See test_properties.py for shapes."""
    arguments = {
        "means": torch.zeros(2, 3),
        "quats": torch.ones(2, 4),
        "scales": torch.ones(2, 3),
        "opacities": torch.ones(2),
        "colors": torch.ones(2, 3),
        "viewmat": torch.eye(4),
        "K": torch.eye(3),
        "width": 4,
        "height": 4,
    }
    rasterization(**arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=name):
        rasterization(**{**arguments, name: value})  # type: ignore[arg-type]


def test_resolve_device(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_device("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device() == resolve_device("auto") == torch.device("cpu")
    with pytest.raises(BackendError, match="no CUDA GPU"):
        resolve_device("cuda")
    with pytest.raises(UsageError, match="tpu"):
        resolve_device("tpu")  # type: ignore[arg-type]


def test_gpu_without_gsplat_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=object()))
    assert resolve_device("auto") == resolve_device("cuda") == torch.device("cuda")
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=None))
    with pytest.raises(BackendError, match="gsplat's CUDA kernels are missing"):
        resolve_device("cuda")
    with pytest.warns(RuntimeWarning, match="gsplat's CUDA kernels are missing"):
        assert resolve_device("auto") == torch.device("cpu")
