"""The signature is gsplat's; errors name invalid and unsupported arguments."""

from __future__ import annotations

import inspect
import math
import sys
from types import SimpleNamespace
from typing import Any

import gsplat
import pytest
import torch

from keyss.core import BackendError, UsageError
from keyss.rendering import IGNORED, ONLY_VALUES, rasterization, resolve_device
from rendering.scenes import random_scene


def good_arguments() -> dict[str, Any]:
    return {
        "means": torch.zeros(2, 3),
        "quats": torch.ones(2, 4),
        "scales": torch.ones(2, 3),
        "opacities": torch.ones(2),
        "colors": torch.ones(2, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.eye(3)[None],
        "width": 4,
        "height": 4,
    }


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", torch.zeros(2, 3, dtype=torch.int64)),
        ("width", 0),
        ("width", 2**20),
        ("near_plane", 0.0),
        ("far_plane", 0.001),
        ("eps2d", 0.1),
        ("sh_degree", 5),
        ("backgrounds", torch.zeros(1, 3, dtype=torch.bool)),
        ("quats", torch.ones(2, 4, dtype=torch.complex64)),
        ("quats", [[1.0, 0, 0, 0]]),
        ("colors", None),
        ("viewmats", torch.full((1, 4, 4), math.nan)),
        ("Ks", torch.full((1, 3, 3), math.inf)),
        ("Ks", -torch.eye(3)[None]),
        ("backgrounds", torch.tensor([[0.0, math.nan, 0.0]])),
        ("near_plane", math.nan),
    ],
)
def test_wrong_types_and_values(name: str, value: object) -> None:
    """See test_properties.py for shapes."""
    with pytest.raises(ValueError, match=name):
        rasterization(**{**good_arguments(), name: value})


def test_sh_degree_needs_its_coefficients() -> None:
    with pytest.raises(ValueError, match=r"sh_degree 2 needs at least 9 coefficients, got \[2, 4, 3\]"):
        rasterization(**{**good_arguments(), "colors": torch.zeros(2, 4, 3), "sh_degree": 2})
    with pytest.raises(ValueError, match=r"colors: expected shape \[2, K, 3\]"):
        rasterization(**{**good_arguments(), "sh_degree": 0})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("colors", torch.ones(2, 33)),
        ("colors", torch.ones(2, 0)),
        ("colors", torch.ones(1, 2, 3)),  # colours per camera
        ("means", torch.zeros(1, 2, 3)),
        ("viewmats", torch.eye(4).expand(1, 1, 4, 4)),
        ("sh_degree", 4),
        ("viewmats", torch.eye(4)[None].requires_grad_()),
        ("radius_clip", 1.0),
        ("render_mode", "RGB+ED"),
        ("rasterize_mode", "antialiased"),
        ("absgrad", True),
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("covars", torch.eye(3).expand(2, 3, 3)),
        ("with_ut", True),
        ("radial_coeffs", torch.zeros(1, 6)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM),
        ("viewmats_rs", torch.eye(4)[None]),
    ],
)
def test_unsupported_arguments(name: str, value: object) -> None:
    with pytest.raises(UsageError, match=f"^{name}:"):
        rasterization(**{**good_arguments(), name: value})


def test_signature_matches_gsplat() -> None:
    """Fails if a release of gsplat adds an argument."""
    theirs = inspect.signature(gsplat.rasterization).parameters
    ours = {
        name: parameter.default
        for name, parameter in inspect.signature(rasterization).parameters.items()
        if name != "others"
    }
    assert theirs.keys() == ours.keys() | ONLY_VALUES.keys() | IGNORED
    assert list(theirs)[:9] == list(ours)[:9]
    for name, default in (ours | ONLY_VALUES).items():
        if name != "rolling_shutter":  # an enumeration in gsplat
            assert default == theirs[name].default, name
    with pytest.raises(TypeError, match="unexpected keyword argument 'sharpness'"):
        rasterization(**good_arguments(), sharpness=1)


@pytest.mark.parametrize(
    "options",
    [
        {"packed": False},
        {"packed": True},
        {"tile_size": 8},
        {"channel_chunk": 4},
        {"segmented": True},
        {"rolling_shutter": gsplat.RollingShutterType.GLOBAL},
        {"sparse_grad": False, "distributed": False, "camera_model": "pinhole", "covars": None},
    ],
)
def test_performance_options_change_nothing(options: dict[str, Any]) -> None:
    scene = random_scene()
    expected = scene.results()
    for name, tensor in scene.results(**options).items():
        assert torch.equal(tensor, expected[name]), name


def test_devices() -> None:
    with pytest.raises(ValueError, match="quats: is on meta"):
        rasterization(**{**good_arguments(), "quats": torch.ones(2, 4, device="meta")})
    everything = {
        name: value.to("meta") if isinstance(value, torch.Tensor) else value
        for name, value in good_arguments().items()
    }
    with pytest.raises(UsageError, match="meta"):
        rasterization(**everything)


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
