"""Parsing inverts serialising, and a model is quantised to the nearest codes."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from files.formats.examples import KINDS, assert_close, is_finite, model_of, random_codes, random_spz
from keyss.core import Gaussians, OutputError
from keyss.files.formats.codebooks import palette_of
from keyss.files.formats.common import from_smallest_three, smallest_three, unit
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

SEEDS, COUNTS, DEGREES = st.integers(0, 2**32 - 1), st.integers(1, 300), st.sampled_from([0, 3, 8, 15])


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15, deadline=None)
@given(SEEDS, COUNTS, DEGREES)
def test_codes_round_trip(kind: str, seed: int, count: int, k: int) -> None:
    codes = random_codes(kind, np.random.default_rng(seed), count, k)
    again = type(codes).parse(codes.serialise())
    assert again == codes
    assert is_finite(again.dequantise())


def test_spz_extensions_are_kept() -> None:
    for version in (3, 4):
        codes = replace(random_spz(np.random.default_rng(0), version, 9, 3), flags=2, extensions=b"\1\2\3")
        assert SpzCodes.parse(codes.serialise()) == codes


def settings_of(data: bytes) -> list[tuple[int, int]]:
    """Levels and memory (zlib's `memLevel`) with which a gzip file is what zlib makes of its content."""
    content, found = zlib.decompress(data, 31), []
    for level, memory in product(range(1, 10), (8, 9)):
        packer = zlib.compressobj(level, zlib.DEFLATED, -15, memory)
        if packer.compress(content) + packer.flush() == data[10:-8]:
            found.append((level, memory))
    return found


@pytest.mark.parametrize(("level", "memory"), [(6, 9), (1, 8)])
def test_spz_keeps_its_gzip_settings(level: int, memory: int) -> None:
    """Otherwise compressing its content once more would tell that it was changed."""
    codes = random_spz(np.random.default_rng(0), 3, 30_000, 3)
    content = zlib.decompress(codes.serialise(), 31)
    packer = zlib.compressobj(level, zlib.DEFLATED, -15, memory)
    head = b"\x1f\x8b\x08\0" + b"\x12\x34\x56\x78" + b"\0\xff"  # with a time and a system
    end = struct.pack("<II", zlib.crc32(content), len(content))
    read = SpzCodes.parse(head + packer.compress(content) + packer.flush() + end)
    again = replace(read, alphas=read.alphas ^ 1).serialise()
    assert again[:10] == head
    assert (level, memory) in settings_of(again)
    assert SpzCodes.parse(again) == replace(read, alphas=read.alphas ^ 1)


def test_new_spz_has_niantics_gzip_settings() -> None:
    found = settings_of(SpzCodes.quantise(model_of(20_000, 1)).serialise())
    assert (6, 9) in found
    assert (6, 8) not in found


def worst(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).abs().max())


def angle(a: Gaussians, b: Gaussians) -> float:
    """The largest angle between rotations of two models, in degrees."""
    both = [torch.nn.functional.normalize(each.quats.double()) for each in (a, b)]
    return float(2 * torch.rad2deg(torch.acos((both[0] * both[1]).sum(1).abs().clamp_max(1)).max()))


def rotation_bound(step: float) -> float:
    """The largest angle in degrees from rounding components of a quaternion to multiples of `step`.

    Three errors of half a step and, where all parts are equal, the sum of them in the fourth.
    """
    return float(np.degrees(2 * np.sqrt(3 + 3**2) * step / 2)) * 1.001


def spz_harmonics_bound(degree: int) -> torch.Tensor:
    """[K - 1, 1] half a step of 5 bits in degree 1 and of 4 bits above, after rounding to 8 bits."""
    steps = torch.tensor([8] * 3 + [16] * 12)[: (degree + 1) ** 2 - 1, None]
    return (steps / 2 + 0.5) / 128 + 1e-6


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_quantisation_error_of_spz(degree: int) -> None:
    model = model_of(400, degree)
    found = SpzCodes.quantise(model).dequantise()
    assert worst(found.means, model.means) <= 0.5 / 4096 + 1e-6
    assert worst(found.log_scales, model.log_scales) <= 0.5 / 16 + 1e-6
    assert worst(found.opacities, model.opacities) <= 0.5 / 255 + 1e-6
    assert worst(found.sh[:, 0], model.sh[:, 0]) <= 0.5 / 38.25 + 1e-6
    errors = found.sh[:, 1:] - model.sh[:, 1:].clamp(-1, 127 / 128)
    assert bool((errors.abs() <= spz_harmonics_bound(degree)).all())
    assert angle(found, model) <= rotation_bound(0.5**0.5 / 511)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_quantisation_error_of_compressed_ply(degree: int) -> None:
    model = model_of(600, degree)
    found = CompressedPlyCodes.quantise(model).dequantise()
    for start in range(0, 600, 256):
        part, near = model[start : start + 256], found[start : start + 256]
        for name, bits in (("means", (11, 10, 11)), ("log_scales", (11, 10, 11))):
            values = getattr(part, name)
            step = (values.amax(0) - values.amin(0)) / (2.0 ** torch.tensor(bits) - 1)
            assert bool(((getattr(near, name) - values).abs() <= 0.5 * step + 1e-5).all())
        colors = part.sh[:, 0]
        step = (colors.amax(0) - colors.amin(0)) / 255
        assert bool(((near.sh[:, 0] - colors).abs() <= 0.5 * step + 1e-5).all())
    assert worst(found.opacities, model.opacities) <= 0.5 / 255 + 1e-6
    if degree:
        assert worst(found.sh[:, 1:], model.sh[:, 1:]) <= 0.5 / 32 + 1e-6
    assert angle(found, model) <= rotation_bound(2**0.5 / 1023)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_quantisation_error_of_sog(degree: int) -> None:
    model = model_of(400, degree)
    codes = SogCodes.quantise(model)
    found = codes.dequantise()
    logs = torch.log1p(model.means.double().abs())
    step = (torch.from_numpy(codes.maxs) - torch.from_numpy(codes.mins)) / 65535
    assert bool(((found.means - model.means).abs() <= 0.5 * step * logs.exp() * 1.01 + 1e-5).all())
    assert worst(found.opacities, model.opacities) <= 0.5 / 255 + 1e-6
    assert angle(found, model) <= rotation_bound(2**0.5 / 255)
    # 256 numbers for 1,200 values: not worse than as many in equal steps would be.
    for found_values, values in ((found.log_scales, model.log_scales), (found.sh[:, 0], model.sh[:, 0])):
        step_of_256 = float(values.max() - values.min()) / 256
        assert float((found_values - values).square().mean()) ** 0.5 <= step_of_256 / 12**0.5


@pytest.mark.parametrize("reach", [1.0, 3000.0, 100_000.0, 8_000_000.0])
def test_spz_precision_of_large_models(reach: float) -> None:
    model = model_of(30, 0)
    model = replace(model, means=model.means / model.means.abs().max() * reach)
    codes = SpzCodes.quantise(model)
    assert worst(codes.dequantise().means, model.means) <= 0.51 * 2.0**-codes.fractional_bits
    assert reach > 2048 or codes.fractional_bits == 12


@pytest.mark.filterwarnings("ignore:.*between which .spz holds scales")
@pytest.mark.parametrize("scale", [1.0, 0.1, 0.001, 0.0001])
@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_spz_precision_in_small_units(scale: float, offset: float) -> None:
    """Positions keep 1/2048 of the median distance from the middle, as far as 24 bits reach."""
    model = model_of(2000, 0)
    log_scales = model.log_scales + math.log(scale)
    model = replace(model, means=(model.means + offset) * scale, log_scales=log_scales)
    codes = SpzCodes.quantise(model)
    assert codes.fractional_bits == 12 if scale == 1 else codes.fractional_bits > 12
    distance = (model.means - model.means.median(dim=0).values).abs().amax(dim=1).median()
    assert worst(codes.dequantise().means, model.means) <= float(distance) / 2048 * 1.01
    assert len(np.unique(codes.positions, axis=0)) == 2000
    assert SpzCodes.parse(codes.serialise()) == codes


def test_spz_position_limit() -> None:
    model = model_of(3, 0)
    with pytest.raises(OutputError, match="up to 8,388,607 world units"):
        SpzCodes.quantise(replace(model, means=model.means * 1e9))


def test_equal_gaussians_and_zero_quaternions() -> None:
    model = model_of(2, 3)[torch.ones(300, dtype=torch.long)]
    model = replace(model, quats=torch.zeros(300, 4))
    for codes in (SpzCodes, CompressedPlyCodes, SogCodes):
        found = codes.quantise(model).dequantise()
        assert_close(found, replace(model, quats=torch.tensor([[1.0, 0, 0, 0]]).expand(300, 4)), 0.07)


# --- what they share ------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_smallest_three(seed: int) -> None:
    quats = unit(np.random.default_rng(seed).normal(size=(20, 4)))
    largest, others = smallest_three(quats)
    assert np.abs(others).max() <= np.sqrt(0.5) + 1e-12
    again = from_smallest_three(largest, others)
    assert np.abs(np.abs((again * quats).sum(axis=1)) - 1).max() < 1e-12


def test_small_palettes() -> None:
    vectors = np.random.default_rng(0).normal(size=(100, 9)).astype(np.float32)
    palette, labels = palette_of(vectors, 128)
    assert np.allclose(palette[labels], vectors)
    palette, labels = palette_of(np.full((9, 9), 1e30, np.float32), 8)
    assert len(palette) == 1
    assert np.allclose(palette[labels], 1e30)
