"""What an attacker renders: each attack changes a model as it says, and in nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from keyss.core import Gaussians
from keyss.lab import file_attacks
from tiny_scenes import random_gaussians, tiny_scene

ATTRIBUTES = ("quaternion length", "scale", "SH energy")
OPAQUE = 0.99


def _variants(attack: str, model: Gaussians) -> dict[str, Gaussians]:
    """The models that an attack renders, by their labels."""
    (own,) = (each for each in file_attacks(tiny_scene(), cover_views=4) if each.name == attack)
    return dict(own.show(model))


def _with_opacities(opacities: Sequence[float] | Tensor) -> Gaussians:
    values = torch.as_tensor(opacities)
    return replace(random_gaussians(len(values)), opacity_logits=values.logit())


def _same_but_opacities(a: Gaussians, b: Gaussians) -> bool:
    names = [f.name for f in fields(Gaussians) if f.name != "opacity_logits"]
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


def test_restoring_makes_those_below_the_threshold_opaque_and_leaves_out_the_others() -> None:
    model = _with_opacities([0.001, 0.049, 0.051, 0.9])
    shown = _variants("restored opacities", model)
    assert _same_but_opacities(shown["below 0.05"], model[:2])
    assert shown["below 0.05"].opacities.tolist() == pytest.approx([OPAQUE] * 2)
    assert _same_but_opacities(shown["all"], model)


def test_rescaling_keeps_proportions() -> None:
    model = _with_opacities([1e-6, 1e-5, 2e-5, 4e-5])
    shown = _variants("rescaled opacities", model)["below 0.01"]
    assert _same_but_opacities(shown, model)
    assert float(shown.opacities.max()) == pytest.approx(OPAQUE)
    ratios = shown.opacities[:3] / shown.opacities[0]
    assert ratios.tolist() == pytest.approx([1, 10, 20], rel=1e-3)


def test_rescaling_goes_by_more_than_one_outlier() -> None:
    shown = _variants("rescaled opacities", _with_opacities([1e-4] * 999 + [0.04]))["below 0.05"]
    assert shown.opacities.tolist() == pytest.approx([OPAQUE] * 1000)


def test_matching_keeps_the_order_and_gives_the_distribution_of_the_others() -> None:
    generator = torch.Generator().manual_seed(0)
    below = torch.rand(500, generator=generator) * 0.01
    above = 0.2 + 0.7 * torch.rand(2000, generator=generator)
    shown = _variants("matched opacities", _with_opacities(torch.cat([below, above])))["below 0.05"]
    assert torch.equal(shown.opacity_logits.argsort(), below.argsort())
    levels = torch.linspace(0, 1, 11)
    torch.testing.assert_close(shown.opacities.quantile(levels), above.quantile(levels), atol=5e-3, rtol=0)


def test_inverting_turns_each_opacity_over() -> None:
    model = _with_opacities([0.1, 0.5, 0.8])
    shown = _variants("inverted opacities", model)
    assert shown["all"].opacities.tolist() == pytest.approx([0.9, 0.5, 0.2])
    assert shown["below 0.2"].opacities.tolist() == pytest.approx([0.9])
    assert _same_but_opacities(shown["all"], model)


def test_least_contributing_are_those_that_no_camera_sees() -> None:
    model = random_gaussians(100)
    hidden = torch.zeros(100, dtype=torch.bool)
    hidden[torch.randperm(100, generator=torch.Generator().manual_seed(0))[:30]] = True
    model = replace(model, means=torch.where(hidden[:, None], model.means + 100, model.means))
    shown = _variants("least contribution", model)["30%"]
    assert len(shown) == 30
    assert (shown.means > 50).all()


def _planted(attribute: str, factor: float) -> Gaussians:
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
@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_a_planted_group_is_an_outlier_in_its_attribute_only(planted: str, attribute: str) -> None:
    for factor, side, other in ((1000.0, "high", "low"), (1e-3, "low", "high")):
        shown = _variants(f"outliers in {attribute}", _planted(planted, factor))
        natural = _variants(f"outliers in {attribute}", random_gaussians(400))
        found, usual = (
            set(each[f"{side}, 3.5 deviations"].means[:, 0].tolist()) for each in (shown, natural)
        )
        last = set(random_gaussians(400).means[360:, 0].tolist())
        assert found - usual == (last - usual if planted == attribute else set())
        assert len(shown[f"{other}, 3.5 deviations"]) <= len(natural[f"{other}, 3.5 deviations"])


def test_attributes_that_are_equal_but_for_rounding_have_no_outliers() -> None:
    model = random_gaussians(100)
    model = replace(model, quats=torch.nn.functional.normalize(model.quats, dim=1))
    assert [len(each) for each in _variants("outliers in quaternion length", model).values()] == [0] * 4


def test_clusters_part_the_model_and_tell_two_kinds_from_each_other() -> None:
    cover, other = random_gaussians(300), random_gaussians(120, seed=1)
    other = replace(other, opacity_logits=other.opacity_logits - 9, log_scales=other.log_scales - 2)
    order = torch.randperm(420, generator=torch.Generator().manual_seed(0))
    shown = _variants("clusters", Gaussians.cat([cover, other])[order])
    assert set(shown["1 of 2"].means[:, 0].tolist()) == set(cover.means[:, 0].tolist())
    assert set(shown["2 of 2"].means[:, 0].tolist()) == set(other.means[:, 0].tolist())
    assert (shown["1 of 2"].opacities > 0.98).all()


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
