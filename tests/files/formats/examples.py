"""Models and codes for tests of formats, and a comparison of models."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from keyss.core import Gaussians
from keyss.files.formats.common import Codes
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes
from tiny_scenes import random_gaussians


def model_of(count: int, degree: int, seed: int = 0) -> Gaussians:
    """A model a few units large, with opacities that bytes round to 0 and 255."""
    model = random_gaussians(count, seed, degree)
    opacity_logits = model.opacity_logits.clone()
    opacity_logits[:2] = torch.tensor([-12.0, 12.0])
    return replace(model, opacity_logits=opacity_logits, quats=model.quats * 3)


def assert_close(a: Gaussians, b: Gaussians, tolerance: float = 1e-5) -> None:
    """Assert that values agree up to rounding: quaternions as rotations, and opacities instead of logits."""
    assert (len(a), a.sh_degree) == (len(b), b.sh_degree)
    for name in ("means", "log_scales", "opacities", "sh"):
        ours, theirs = getattr(a, name).double(), getattr(b, name).double()
        worst = float(((ours - theirs).abs() / theirs.abs().clamp_min(1)).max())
        assert worst <= tolerance, (name, worst)
    unit_a, unit_b = (torch.nn.functional.normalize(each.quats.double()) for each in (a, b))
    assert float(1 - (unit_a * unit_b).sum(dim=1).abs().min()) <= tolerance


def same_codes(one: Codes, other: Codes) -> bool:
    """True if the codes that two files hold are equal; what else they keep of the files does not count."""
    names = [field.name for field in fields(one) if field.name not in ("comments", "packed")]  # type: ignore[arg-type]
    pairs = [(np.asarray(getattr(one, name)), np.asarray(getattr(other, name))) for name in names]
    return type(one) is type(other) and all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in pairs)


def is_finite(model: Gaussians) -> bool:
    return all(bool(getattr(model, field.name).isfinite().all()) for field in fields(model))


def random_spz(rng: np.random.Generator, version: int, count: int, k: int) -> SpzCodes:
    def drawn(most: int, *shape: int, kind: type = np.uint8) -> np.ndarray:
        return rng.integers(0, most, (count, *shape)).astype(kind)

    return SpzCodes(
        version=version,
        fractional_bits=int(rng.integers(0, 25)),
        flags=int(rng.integers(0, 2)),
        positions=(drawn(2**24, 3, kind=np.int32) - 2**23).astype(np.int32),
        alphas=drawn(256),
        colors=drawn(256, 3),
        scales=drawn(256, 3),
        largest=np.full(count, 3, np.uint8) if version == 2 else drawn(4),
        rotations=drawn(256 if version == 2 else 1024, 3, kind=np.uint16),
        sh=drawn(256, k, 3),
    )


def random_sog(rng: np.random.Generator, count: int, k: int) -> SogCodes:
    def drawn(most: int, *shape: int, kind: type = np.uint8) -> np.ndarray:
        return rng.integers(0, most, shape).astype(kind)

    def book() -> np.ndarray:
        return np.sort(rng.normal(size=256)).astype(np.float32)

    size = int(rng.integers(1, 200)) if k else 1
    return SogCodes(
        mins=-rng.random(3),
        maxs=rng.random(3),
        positions=drawn(65536, count, 3, kind=np.uint16),
        largest=drawn(4, count),
        rotations=drawn(256, count, 3),
        scale_codebook=book(),
        scales=drawn(256, count, 3),
        color_codebook=book(),
        colors=drawn(256, count, 3),
        alphas=drawn(2, count) * np.uint8(255),  # 0 too, under which images like to forget colours
        sh_codebook=book() if k else np.empty(0, np.float32),
        palette=drawn(256, size, k, 3),
        labels=drawn(size, count, kind=np.uint16),
    )


def random_compressed(rng: np.random.Generator, count: int, k: int) -> CompressedPlyCodes:
    def drawn(bits: list[int], kind: type) -> np.ndarray:
        return np.stack([rng.integers(0, 2**bit, count) for bit in bits], axis=1).astype(kind)

    bounds = np.sort(rng.normal(size=(-(-count // 256), 3, 2, 3)), axis=2).astype(np.float32)
    return CompressedPlyCodes(
        bounds=bounds.reshape(-1, 18),
        positions=drawn([11, 10, 11], np.uint16),
        largest=rng.integers(0, 4, count).astype(np.uint8),
        rotations=drawn([10, 10, 10], np.uint16),
        scales=drawn([11, 10, 11], np.uint16),
        colors=drawn([8, 8, 8], np.uint8),
        alphas=rng.integers(0, 256, count).astype(np.uint8),
        sh=rng.integers(0, 256, (count, k, 3)).astype(np.uint8),
    )


KINDS = ("spz 2", "spz 3", "spz 4", "sog", "compressed")


def random_codes(kind: str, rng: np.random.Generator, count: int, k: int) -> Any:
    """Of one of KINDS: a format, and the version of an SPZ."""
    if kind.startswith("spz"):
        return random_spz(rng, int(kind[-1]), count, k)
    return random_sog(rng, count, k) if kind == "sog" else random_compressed(rng, count, k)
