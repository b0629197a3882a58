"""Error bounds of quantised records; outliers do not cost the precision of other Gaussians."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays

import keyss
from channels.quiet.trained_like import trained_like
from keyss import Secret
from keyss.core import DRAWN_OPACITY, Gaussians, InputError
from keyss.files import write_model
from keyss.methods import Codec, Line, Table
from keyss.rendering import render
from tiny_scenes import ring_cameras

FINITE = st.floats(-1e6, 1e6, width=32)
VALUES = arrays.arrays(np.float64, st.integers(1, 30), elements=FINITE)

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
    """A model in view of `ring_cameras`, with correlated colours, as in trained models."""
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
    assert table.record_bytes <= bits // 8
    codec, outliers = Codec.fit(model, table)
    assert Codec.unpack(codec.pack()) == codec
    back = codec.decode(codec.encode(model, outliers))
    assert all(torch.isfinite(getattr(back, name)).all() for name in NAMES)
    return back


def _psnr(one: Gaussians, other: Gaussians) -> float:
    views = [(render(each, camera).clamp(0, 1) for each in (one, other)) for camera in ring_cameras(2)]
    error = torch.stack([(a - b).square().mean() for a, b in views]).mean()
    return float(-10 * torch.log10(error))


@given(VALUES, st.floats(0, 1e3), st.floats(0.01, 50), st.integers(1, 24))
def test_line_error(values: np.ndarray, spread: float, reach: float, bits: int) -> None:
    line = Line(1.5, spread if spread > 1e-3 else 0.0, reach, far_reach=1.0)

    def position(x: np.ndarray) -> np.ndarray:
        return np.arcsinh((x - 1.5) / line.spread) if line.spread else x - 1.5

    decoded = line.decode(line.encode(values, bits), bits)
    off = np.abs(position(decoded) - position(values).clip(-reach, reach))
    assert (off <= reach / ((1 << bits) - 1) * (1 + 1e-6) + 1e-9 * reach).all()


@given(st.data(), st.integers(0, 3), st.sampled_from([0, 40, 500]))
@settings(max_examples=25, deadline=None)
def test_codec_error(data: st.DataObject, degree: int, more: int) -> None:
    count = data.draw(st.integers(1, 12))

    def some(*shape: int) -> torch.Tensor:
        return torch.from_numpy(data.draw(arrays.arrays(np.float32, (count, *shape), elements=FINITE)))

    model = Gaussians(some(3), some(4), 1e-5 * some(3), some(), some((degree + 1) ** 2, 3))
    table = Table.of_size(Table.floor(degree).total + more, degree)
    assert table is not None
    assert table.total <= Table.floor(degree).total + more
    codec, off = Codec.fit(model, table)
    back = codec.decode(codec.encode(model, off))
    assert Codec.unpack(codec.pack()) == codec
    scales = model.log_scales.double()
    line = codec.lines[3]
    for part, reach in ((~off, line.reach), (off, line.far_reach)):
        step = 2 * reach / ((1 << table.bits[1]) - 1)
        error = (back.log_scales - scales).abs().amax(1).numpy()[part]
        assert error.max(initial=0) <= 0.51 * step + 1e-6 * float(scales.abs().max()) + 1e-6
    for axis, line in enumerate(codec.lines[:3]):
        for part, reach in ((~off, line.reach), (off, line.far_reach)):
            was, now = (m.means[:, axis].double().numpy()[part] for m in (model, back))
            error = np.arcsinh((was - line.centre) / line.spread) - np.arcsinh(
                (now - line.centre) / line.spread
            )
            # Rounding to float32.
            rounded = np.spacing(np.abs(now).astype(np.float32)).astype(np.float64) / 2 / line.spread
            assert (np.abs(error) <= 1.1 * reach / ((1 << table.bits[0]) - 1) + rounded + 1e-5).all()
    assert torch.isfinite(back.sh).all()
    length = model.quats.double().norm(dim=1)
    unit = model.quats.double() / length[:, None].clamp_min(1e-60)
    same = (unit * back.quats.double()).sum(1).abs()[length > 1e-11]  # shorter ones are zero
    # Half a step of sqrt(2) / (2^bits - 1) for three components; the fourth follows.
    assert (1 - same <= 6 * (0.5**0.5 / ((1 << table.bits[2]) - 1)) ** 2 + 1e-6).all()
    assert torch.allclose(back.quats.norm(dim=1), torch.ones(count), atol=1e-5)


def test_zero_and_negated_quaternions() -> None:
    model = trained_like(8, sh_degree=0)
    model.quats[0] = 0
    model.quats[1] = torch.tensor([0.0, -3.0, 0, 0])
    codec, outliers = Codec.fit(model, Table.floor(0))
    quats = codec.decode(codec.encode(model, outliers)).quats
    assert torch.allclose(quats[:2].abs(), torch.eye(4)[:2], atol=0.01)


def test_render_quality() -> None:
    model = _bulk(2000, seed=4)
    for bits, least in ((264, 40), (568, 65)):
        assert _psnr(model, _round_trip(model, bits)) > least


@given(st.binary(max_size=150))
def test_damaged_parameters(data: bytes) -> None:
    try:
        codec = Codec.unpack(data)
    except InputError:
        return
    records = np.random.default_rng(0).integers(0, 256, (20, codec.table.record_bytes), dtype=np.uint8)
    assert all(torch.isfinite(values).all() for values in vars(codec.decode(records)).values())


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
