"""What an attacker renders: each view shows what it says, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from keyss.core import Gaussians
from keyss.measure import file_attacks
from keyss.measure.leaks.views import (
    OPAQUE,
    Attribute,
    clusters,
    faint,
    inverted,
    least_contributing,
    matched,
    measured,
    opaque,
    outliers,
    rescaled,
)
from keyss.rendering import contributions
from tiny_scenes import random_gaussians, ring_cameras, tiny_scene

ATTRIBUTES: tuple[Attribute, ...] = ("quaternion length", "scale", "SH energy")


def _with_opacities(opacities: Sequence[float] | Tensor) -> Gaussians:
    values = torch.as_tensor(opacities)
    return replace(random_gaussians(len(values)), opacity_logits=values.logit())


def _same_but_opacities(a: Gaussians, b: Gaussians) -> bool:
    names = [f.name for f in fields(Gaussians) if f.name != "opacity_logits"]
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


def test_faint_ones_are_those_below_the_threshold_and_opaque_ones_hide_what_is_behind() -> None:
    model = _with_opacities([0.001, 0.049, 0.051, 0.9])
    shown = opaque(faint(model, 0.05))
    assert _same_but_opacities(shown, model[:2])
    assert shown.opacities.tolist() == pytest.approx([OPAQUE] * 2)


def test_rescaling_keeps_proportions() -> None:
    model = _with_opacities([1e-6, 1e-5, 2e-5, 4e-5])
    shown = rescaled(model)
    assert _same_but_opacities(shown, model)
    assert float(shown.opacities.max()) == pytest.approx(OPAQUE)
    ratios = shown.opacities[:3] / shown.opacities[0]
    assert ratios.tolist() == pytest.approx([1, 10, 20], rel=1e-3)


def test_rescaling_goes_by_more_than_one_outlier() -> None:
    shown = rescaled(_with_opacities([1e-3] * 999 + [0.5]))
    assert shown.opacities.tolist() == pytest.approx([OPAQUE] * 1000)


def test_matching_keeps_the_order_and_gives_the_distribution_of_the_others() -> None:
    generator = torch.Generator().manual_seed(0)
    below, above = (
        torch.rand(500, generator=generator) * 0.01,
        0.2 + 0.7 * torch.rand(2000, generator=generator),
    )
    shown = matched(_with_opacities(torch.cat([below, above])), 0.05)
    assert torch.equal(shown.opacity_logits.argsort(), below.argsort())
    levels = torch.linspace(0, 1, 11)
    torch.testing.assert_close(shown.opacities.quantile(levels), above.quantile(levels), atol=5e-3, rtol=0)


def test_inverting_turns_each_opacity_over() -> None:
    model = _with_opacities([0.1, 0.5, 0.8])
    assert inverted(model).opacities.tolist() == pytest.approx([0.9, 0.5, 0.2])
    assert _same_but_opacities(inverted(model), model)


def test_least_contributing_are_those_that_no_camera_sees() -> None:
    model = random_gaussians(100)
    hidden = torch.zeros(100, dtype=torch.bool)
    hidden[torch.randperm(100, generator=torch.Generator().manual_seed(0))[:30]] = True
    model = replace(model, means=torch.where(hidden[:, None], model.means + 100, model.means))
    shown = least_contributing(model, contributions(model, ring_cameras(4)), 0.3)
    assert len(shown) == 30
    assert (shown.means > 50).all()


def _planted(attribute: Attribute, factor: float) -> Gaussians:
    """The last 40 of 400 have an attribute multiplied."""
    model = random_gaussians(400)
    last = torch.arange(400) >= 360
    if attribute == "quaternion length":
        return replace(model, quats=torch.where(last[:, None], factor * model.quats, model.quats))
    if attribute == "scale":
        larger = model.log_scales + torch.tensor(factor).log()
        return replace(model, log_scales=torch.where(last[:, None], larger, model.log_scales))
    sh = model.sh.clone()
    sh[last, 1:] *= factor
    return replace(model, sh=sh)


@pytest.mark.parametrize("planted", ATTRIBUTES)
@pytest.mark.parametrize("looked_at", ATTRIBUTES)
def test_a_planted_group_is_an_outlier_in_its_attribute_only(
    planted: Attribute, looked_at: Attribute
) -> None:
    model = _planted(planted, 1000.0)
    shown = outliers(model, looked_at, "high", 5.0)
    expected = model.means[360:] if planted == looked_at else model.means[:0]
    assert torch.equal(shown.means, expected)
    assert len(outliers(model, looked_at, "low", 8.0)) == 0


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_a_group_with_less_is_on_the_low_side(attribute: Attribute) -> None:
    shown = outliers(_planted(attribute, 1e-3), attribute, "low", 5.0)
    assert torch.equal(shown.means, random_gaussians(400).means[360:])


def test_attributes_that_are_equal_but_for_rounding_have_no_outliers() -> None:
    model = random_gaussians(100)
    model = replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))
    assert measured(model, "quaternion length").abs().max() < 1e-5
    assert len(outliers(model, "quaternion length", "high", 2.0)) == 0


def test_clusters_part_the_model_and_tell_two_kinds_from_each_other() -> None:
    cover, other = random_gaussians(300), random_gaussians(120, seed=1)
    other = replace(other, opacity_logits=other.opacity_logits - 9, log_scales=other.log_scales - 2)
    order = torch.randperm(420, generator=torch.Generator().manual_seed(0))
    first, second = clusters(Gaussians.cat([cover, other])[order], 2)
    assert set(first.means[:, 0].tolist()) == set(cover.means[:, 0].tolist())
    assert set(second.means[:, 0].tolist()) == set(other.means[:, 0].tolist())
    assert (first.opacities > 0.98).all()


@pytest.mark.parametrize("count", [0, 1, 12])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_attacks_show_the_same_labels_of_any_model_and_change_nothing(count: int, sh_degree: int) -> None:
    model, large = random_gaussians(count, sh_degree=sh_degree), random_gaussians(50)
    before = model.map(torch.clone)
    for attack in file_attacks(tiny_scene(), cover_views=2):
        shown = list(attack.show(model))
        assert [label for label, _ in shown] == [label for label, _ in attack.show(large)]
        assert len({label for label, _ in shown}) == len(shown)
        assert all(part.opacity_logits.isfinite().all() for _, part in shown)
    assert torch.equal(before.opacity_logits, model.opacity_logits)
    assert _same_but_opacities(before, model)
