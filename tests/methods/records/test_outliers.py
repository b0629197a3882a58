"""Outliers of a secret do not cost the precision of its other Gaussians."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import keyss
from channels.quiet.trained_like import trained_like
from keyss import Gaussians, Secret
from keyss.core import DRAWN_OPACITY
from keyss.files import write_model
from keyss.methods import Codec, Table
from keyss.rendering import render
from tiny_scenes import ring_cameras

KEY = "a key of many characters: 93hXmQ2"
NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
LARGEST = float(np.finfo(np.float32).max)
HOSTILE = (
    *(("means", value) for value in (1e3, -1e10, 1e15, 1e30, LARGEST)),
    *(("log_scales", value) for value in (-30.0, -LARGEST, 10.0, 80.0)),
    *(("opacity_logits", value) for value in (-LARGEST, 16.0, LARGEST)),
    *(("sh", value) for value in (1e3, -1e10, LARGEST)),
    *(("quats", value) for value in (0.0, 1e-20, 1e20, LARGEST)),
)


def _bulk(count: int, seed: int = 0, degree: int = 3) -> Gaussians:
    """A model in view of `ring_cameras`, with correlated colours."""
    model = trained_like(count, seed, degree)
    sh = 0.25 * model.sh + 0.75 * model.sh[:, :, :1]
    return Gaussians(model.means / 4, model.quats, model.log_scales + 1, model.opacity_logits, sh)


def _with(model: Gaussians, rows: torch.Tensor, name: str, value: float) -> Gaussians:
    changed = model.map(torch.clone)
    getattr(changed, name)[rows] = value
    return changed


def _round_trip(model: Gaussians, bits: int) -> Gaussians:
    table = Table.of_size(bits, model.sh_degree)
    assert table is not None
    codec, outliers = Codec.fit(model, table)
    assert Codec.unpack(codec.pack()) == codec
    back = codec.decode(codec.encode(model, outliers))
    assert all(torch.isfinite(getattr(back, name)).all() for name in NAMES)
    return back


def _psnr(one: Gaussians, other: Gaussians) -> float:
    views = [(render(each, camera).clamp(0, 1) for each in (one, other)) for camera in ring_cameras(2)]
    error = torch.stack([(a - b).square().mean() for a, b in views]).mean()
    return float(-10 * torch.log10(error))


@cache
def _psnr_without_outlier() -> tuple[float, float]:
    """Of a model without one of its Gaussians, and of all."""
    model, rest = _bulk(1000), torch.arange(1000) != 17
    plain = _round_trip(model, 264)
    return _psnr(model[rest], plain[rest]), _psnr(model, plain)


@pytest.mark.parametrize(("name", "value"), HOSTILE)
def test_one_outlier_costs_under_1_db(name: str, value: float) -> None:
    model, rest = _bulk(1000), torch.arange(1000) != 17
    changed = _with(model, torch.tensor([17]), name, value)
    found, (others, every) = _round_trip(changed, 264), _psnr_without_outlier()
    assert _psnr(model[rest], found[rest]) > others - 1
    # The outlier itself renders as before.
    assert _psnr(changed, found) > every - 3


def test_undrawable_gaussians() -> None:
    model = _with(_bulk(200), torch.tensor([3]), "means", 1e30)
    assert model.overflow.nonzero().tolist() == [[3]]
    back = _round_trip(model, 568)
    assert float(back.opacities[3]) < DRAWN_OPACITY
    assert float(back.means[3].abs().max()) < 2e15


@pytest.mark.parametrize("value", [1e10, 1e30])
def test_hide_secret_with_outlier(tmp_path: Path, value: float) -> None:
    secret = _with(_bulk(900, 1), torch.tensor([5]), "means", value)
    write_model(tmp_path / "secret.ply", secret)
    write_model(tmp_path / "cover.ply", trained_like(2000))
    result = keyss.hide(
        tmp_path / "cover.ply",
        [Secret(tmp_path / "secret.ply", KEY)],
        method="carry",
        width=48,
        out=tmp_path / "run",
    )
    assert result.metrics.secrets[0].psnr > 45
    assert result.metrics.details.get("gaussians_with_clamped_numbers") == ([1] if value > 1e15 else None)
    assert _psnr(secret, keyss.reveal(result.stego, KEY).gaussians) > 42
