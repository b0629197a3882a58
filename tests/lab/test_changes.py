"""Each change of a published model: known answers, and the precision that formats promise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from channels.lsb.trained_like import trained_like
from keyss.core import Gaussians, Scene, UsageError
from keyss.fitting import mean_psnr
from keyss.lab import (
    Converter,
    converters,
    cropping,
    fewer_harmonics,
    fine_tuning,
    noise,
    opacity_pruning,
    purification,
    random_pruning,
)
from tiny_scenes import random_gaussians, tiny_scene

NOISY = ("position", "log scale", "quaternion", "logit opacity", "colour", "harmonics")


def parts(model: Gaussians) -> dict[str, torch.Tensor]:
    """Attributes that noise can be added to, by name."""
    values = (
        model.means,
        model.log_scales,
        model.quats,
        model.opacity_logits,
        model.sh[:, :1],
        model.sh[:, 1:],
    )
    return dict(zip(NOISY, values, strict=True))


# --- changes that need nothing but the model -------------------------------------------------------------


@pytest.mark.parametrize("share", [0.05, 0.25, 0.5, 0.999])
def test_random_pruning(share: float) -> None:
    model = random_gaussians(200)
    left = random_pruning(share, seed=3)(model)
    assert len(left) == max(1, round(200 * (1 - share)))
    place = torch.cdist(left.means, model.means).argmin(1)
    assert (place.diff() > 0).all()
    assert left.digest() == model[place].digest()
    assert left.digest() == random_pruning(share, seed=3)(model).digest()
    if len(left) > 1:
        assert not torch.equal(left.means, random_pruning(share, seed=4)(model).means)


def test_opacity_pruning() -> None:
    model = random_gaussians(200)
    left = opacity_pruning(0.15)(model)
    assert torch.equal(left.opacity_logits.sort().values, model.opacity_logits.sort().values[30:])
    assert left.digest() == model[model.opacity_logits >= left.opacity_logits.min()].digest()


@pytest.mark.parametrize("attribute", NOISY)
def test_noise_on_one_attribute(attribute: str) -> None:
    model = trained_like(20_000)
    model = replace(
        model, means=torch.cat([model.means[:-50], 1e4 * model.means[-50:]])
    )  # far away: no matter
    known = dict(zip(NOISY, (2.0, 1.0, 1.0, 2.0, 0.1, 0.1), strict=True))[attribute]
    changed = noise(attribute, 0.1, seed=1)(model)
    for name, before in parts(model).items():
        added = (parts(changed)[name] - before).double()
        if name != attribute:
            assert not added.any()
            continue
        near = slice(0, -50)
        assert float(added[near].std()) == pytest.approx(0.1 * known, rel=0.03)
        assert abs(float(added[near].mean())) < 0.003 * known
    assert changed.digest() == noise(attribute, 0.1, seed=1)(model).digest()
    assert changed.digest() != noise(attribute, 0.1, seed=2)(model).digest()
    with pytest.raises(UsageError, match="expected one of position"):
        noise("rotation", 0.1)


def test_cropping() -> None:
    model = random_gaussians(200)
    line = replace(model, means=model.means * torch.tensor([1.0, 0, 0]))
    left = cropping(seed=5)(line)
    ordered = line.means[:, 0].sort().values
    found = left.means[:, 0].sort().values
    assert torch.equal(found, ordered[:100]) or torch.equal(found, ordered[100:])
    assert len(cropping()(model[:1])) == 1
    assert not torch.equal(cropping(0)(model).means, cropping(1)(model).means)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_fewer_harmonics(degree: int) -> None:
    model = random_gaussians(20)
    changed = fewer_harmonics(degree)(model)
    assert changed.sh_degree == degree
    assert torch.equal(changed.sh, model.sh[:, : (degree + 1) ** 2])
    assert fewer_harmonics(2)(changed).sh_degree == degree  # none are added


# --- changes by somebody with the cover's photos ---------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tiny_scene(0, views=8)


def planted() -> tuple[Gaussians, torch.Tensor]:
    """The scene's model among Gaussians that no photo shows, and which those are."""
    seen = random_gaussians(seed=0)
    transparent = replace(random_gaussians(30, seed=1), opacity_logits=torch.full((30,), -8.0))
    elsewhere = replace(random_gaussians(20, seed=2), means=torch.tensor([0, 0, 90.0]).repeat(20, 1))
    model = Gaussians.cat([transparent, seen, elsewhere])
    invisible = torch.zeros(len(model), dtype=torch.bool)
    invisible[:30] = invisible[-20:] = True
    return model, invisible


def test_purification_removes_invisible_gaussians_only(scene: Scene) -> None:
    model, invisible = planted()
    purified = purification(scene, steps=0)(model)
    assert purified.digest() == model[~invisible].digest()
    assert mean_psnr(purified, scene.test, scene.background) == pytest.approx(
        mean_psnr(model, scene.test, scene.background), abs=1e-3
    )


def test_fine_tuning_repairs_visible_gaussians_only(scene: Scene) -> None:
    model, invisible = planted()
    spoilt = noise("colour", 0.3)(model)
    tuned = fine_tuning(scene, steps=60)(spoilt)
    before, after = (mean_psnr(each, scene.train, scene.background) for each in (spoilt, tuned))
    assert after > before + 3
    assert tuned[invisible].digest() == spoilt[invisible].digest()
    assert tuned.digest() == fine_tuning(scene, steps=60)(spoilt).digest()
    assert fine_tuning(scene, steps=0)(spoilt).digest() == spoilt.digest()


# --- conversions -----------------------------------------------------------------------------------------


def by(format: str, tool: str) -> Converter:
    (found,) = (
        converter for converter in converters() if (converter.format, converter.tool) == (format, tool)
    )
    return found


@pytest.mark.parametrize("format", ["compressed .ply", ".sog"])
def test_splat_transform_converts(format: str, splat_transform: Callable[..., Path]) -> None:
    model = random_gaussians(60)
    back = by(format, "splat-transform")(model)
    assert len(back) == 60
    assert float(torch.cdist(back.means, model.means).amin(1).max()) < 0.01
    assert back.sh_degree == (0 if format == ".splat" else 3)
