"""Each change of a published model: known answers, and the precision that formats promise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from channels.quiet.trained_like import trained_like
from keyss.core import BackendError, Gaussians, Scene, UsageError, same_bits
from keyss.fitting import mean_psnr
from keyss.lab import (
    Change,
    Converter,
    converters,
    cropping,
    fewer_harmonics,
    fine_tuning,
    half_floats,
    measure_robustness,
    noise,
    opacity_pruning,
    purification,
    random_pruning,
)
from keyss.methods import choose_anchors
from lab.opened import Whole
from tiny_scenes import random_gaussians, tiny_scene

NOISY = ("position", "log scale", "quaternion", "logit opacity", "colour", "harmonics")


def parts(model: Gaussians) -> dict[str, torch.Tensor]:
    """What noise can be added to, by its name."""
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
def test_random_pruning_removes_the_share_and_keeps_the_order(share: float) -> None:
    model = random_gaussians(200)
    left = random_pruning(share, seed=3)(model)
    assert len(left) == max(1, round(200 * (1 - share)))
    place = torch.cdist(left.means, model.means).argmin(1)
    assert (place.diff() > 0).all()
    assert same_bits(left, model[place])
    assert same_bits(left, random_pruning(share, seed=3)(model))
    if len(left) > 1:
        assert not torch.equal(left.means, random_pruning(share, seed=4)(model).means)


def test_random_pruning_minds_no_attribute() -> None:
    model = random_gaussians(20_000, sh_degree=0)
    left = random_pruning(0.5)(model)
    error = 3 / 10_000**0.5  # standard deviations of a mean of half of them
    assert abs(left.opacity_logits.mean() - model.opacity_logits.mean()) < error


def test_random_pruning_does_not_draw_what_others_draw() -> None:
    """Anchors are the first of a permutation with the training's seed."""
    model = random_gaussians(2000)
    anchors = choose_anchors(model, 0)
    left = torch.cdist(anchors, random_pruning(0.5, seed=0)(model).means).amin(1) == 0
    assert 0.2 < float(left.float().mean()) < 0.8


def test_pruning_by_opacity_removes_the_lowest() -> None:
    model = random_gaussians(200)
    left = opacity_pruning(0.15)(model)
    assert torch.equal(left.opacity_logits.sort().values, model.opacity_logits.sort().values[30:])
    assert same_bits(left, model[model.opacity_logits >= left.opacity_logits.min()])


@pytest.mark.parametrize("prune", [random_pruning, opacity_pruning])
@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_impossible_shares_are_refused(prune: Callable[[float], Change], share: float) -> None:
    with pytest.raises(UsageError, match="share"):
        prune(share)


@pytest.mark.parametrize("attribute", NOISY)
def test_noise_has_the_standard_deviation_and_touches_nothing_else(attribute: str) -> None:
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
    assert same_bits(changed, noise(attribute, 0.1, seed=1)(model))
    assert not same_bits(changed, noise(attribute, 0.1, seed=2)(model))
    with pytest.raises(UsageError, match="expected one of position"):
        noise("rotation", 0.1)


def test_cropping_keeps_one_side() -> None:
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


def test_half_floats_are_numpys() -> None:
    model = random_gaussians(50)
    for values, before in zip(vars(half_floats()(model)).values(), vars(model).values(), strict=True):
        assert values.dtype == torch.float32
        assert np.array_equal(values.numpy(), before.numpy().astype(np.float16).astype(np.float32))


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


def test_purification_removes_what_is_not_seen_and_nothing_else(scene: Scene) -> None:
    model, invisible = planted()
    purified = purification(scene, steps=0)(model)
    assert same_bits(purified, model[~invisible])
    assert mean_psnr(purified, scene.test, scene.background) == pytest.approx(
        mean_psnr(model, scene.test, scene.background), abs=1e-3
    )


def test_purification_can_give_up_what_is_hardly_seen(scene: Scene) -> None:
    model, invisible = planted()
    faint = model.opacity_logits.clone()
    faint[:30] = -5.0  # 1/150: just drawn
    model = replace(model, opacity_logits=faint)
    exact, generous = (
        torch.cdist(purification(scene, share, steps=0)(model).means, model.means).amin(0) > 0
        for share in (0.0, 0.01)
    )  # which Gaussians are removed
    assert int(exact[:30].sum()) < 15
    assert torch.equal(generous[:30], invisible[:30])
    assert int(generous[30:-20].sum()) < 60
    assert len(purification(scene, 1.0, steps=0)(model)) == 1  # never all of them


def test_training_on_repairs_what_photos_show_and_leaves_what_they_do_not(scene: Scene) -> None:
    model, invisible = planted()
    spoilt = noise("colour", 0.3)(model)
    tuned = fine_tuning(scene, steps=60)(spoilt)
    before, after = (mean_psnr(each, scene.train, scene.background) for each in (spoilt, tuned))
    assert after > before + 3
    assert same_bits(tuned[invisible], spoilt[invisible])
    assert same_bits(tuned, fine_tuning(scene, steps=60)(spoilt))
    assert same_bits(fine_tuning(scene, steps=0)(spoilt), spoilt)


# --- conversions -----------------------------------------------------------------------------------------


def by(format: str, tool: str) -> Converter:
    (found,) = (each for each in converters() if (each.format, each.tool) == (format, tool))
    return found


def test_gsply_spz_rounds_as_the_format_says() -> None:
    """Version 3 by Niantic's description: positions in steps of 2^-12, opacities in steps of 1/255."""
    model = random_gaussians(300)
    back = by(".spz", "gsply")(model)
    assert len(back) == 300
    nearest = torch.cdist(back.means, model.means).argmin(1)
    assert sorted(nearest.tolist()) == list(range(300))
    assert float((back.means - model.means[nearest]).abs().max()) <= 2**-13 + 1e-6
    assert float((back.opacities - model.opacities[nearest]).abs().max()) <= 0.5 / 255 + 1e-5
    assert not torch.equal(back.means, model.means[nearest])


def test_gsply_compresses_in_chunks_of_their_own_range() -> None:
    """PlayCanvas' compressed .ply: of the range of 256 Gaussians, 2^11, 2^10 and 2^11 steps in x, y, z."""
    model = random_gaussians(256)
    back = by("compressed .ply", "gsply").change()(model)
    nearest = torch.cdist(back.means, model.means).argmin(1)
    assert sorted(nearest.tolist()) == list(range(256))
    steps = (model.means.amax(0) - model.means.amin(0)) / torch.tensor([2047.0, 1023.0, 2047.0])
    assert ((back.means - model.means[nearest]).abs() <= 0.51 * steps).all()
    assert same_bits(back, by("compressed .ply", "gsply").change()(model))


@pytest.mark.parametrize("format", ["compressed .ply", ".spz", ".splat", ".sog"])
def test_splat_transform_converts(format: str, splat_transform: Callable[..., Path]) -> None:
    model = random_gaussians(60)
    back = by(format, "splat-transform")(model)
    assert len(back) == 60
    assert float(torch.cdist(back.means, model.means).amin(1).max()) < 0.01
    assert back.sh_degree == (0 if format == ".splat" else 3)


def test_an_absent_tool_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Scene) -> None:
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tmp_path / "nowhere"))
    model, change = random_gaussians(seed=0), by(".sog", "splat-transform").change()
    with pytest.raises(BackendError, match="npm install"):
        change(model)
    rows = measure_robustness(model, [Whole], scene, [scene], changes=[change, half_floats()])
    assert "splat-transform is not installed" in (rows[1].skipped or "")
    assert rows[1].cover is None
    assert rows[2].skipped is None


def test_a_failing_tool_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tool = tmp_path / "splat-transform"
    tool.write_text("#!/bin/sh\necho 'out of luck' >&2\nexit 1\n")
    tool.chmod(0o755)
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tool))
    with pytest.raises(BackendError, match="out of luck"):
        by(".spz", "splat-transform")(random_gaussians(5))
