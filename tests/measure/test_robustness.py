"""What changes of published models cost cover and secrets, and which of them breaks down first."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import pytest
import torch

import keyss
from channels.low_bits.trained_like import trained_like
from keyss import CarryOptions
from keyss.channels import LOW_BITS
from keyss.core import Gaussians, KeyssWarning, Scene, Similarity, UsageError, WrongKeyError
from keyss.fitting import mean_psnr, quality
from keyss.measure import (
    BreakdownPoint,
    ChangedQuality,
    ChangeResult,
    Reopened,
    Reopener,
    StrengthLosses,
    breakdown_points,
    half_floats,
    mean_over_draws,
    measure_robustness,
    noise,
    purification,
    random_pruning,
)
from keyss.measure.robustness.changes import NOISY
from keyss.measure.robustness.survival import First, default_changes
from keyss.methods import open_model, record_request
from methods.carry.carried import embed
from methods.carry.test_refit import TINY
from methods.hiding import hide_scenes, moved, three_scenes
from tiny_scenes import random_gaussians, tiny_scene

KEY = "the right key"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tiny_scene(0, views=8)


def test_losses_are_differences_of_quality(scene: Scene) -> None:
    """The secret is the cover, so that all is known."""
    model = random_gaussians(seed=0)
    changes = [random_pruning(0.5, seed) for seed in (0, 1)]
    steps: list[tuple[int, int, str]] = []
    rows = measure_robustness(
        model, [Reopened], scene, [scene], changes=changes, progress=lambda *step: steps.append(step)
    )
    assert [row.attack for row in rows] == ["none", "random pruning", "random pruning"]
    assert rows[0].cover is not None
    assert rows[0].cover.loss == rows[0].secrets[0].loss == 0
    before = quality(model, scene.test, scene.background)
    for row, change in zip(rows[1:], changes, strict=True):
        now = quality(change(model), scene.test, scene.background)
        assert row.cover == ChangedQuality(now.psnr, now.ssim, before.psnr - now.psnr)
        assert row.secrets == (row.cover,)
        assert row.gaussians == 100
    assert [step[:2] for step in steps] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert measure_robustness(model, [Reopened], scene, [scene], changes=changes) == rows


def test_views_are_bounded() -> None:
    scene, model = tiny_scene(0, views=16), random_gaussians(150, seed=0)
    (row,) = measure_robustness(model, [], scene, [], changes=[], views=1)
    assert row.cover is not None
    assert row.cover.psnr == mean_psnr(model, scene.test[:1], scene.background)


def test_what_is_lost_looks_like_the_cover_from_where_the_secret_is(scene: Scene) -> None:
    """The secret's cameras are the cover's in another frame, so that chance level is the cover's quality."""
    model = random_gaussians(seed=0)
    frame = Similarity(2.0, translation=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    elsewhere = moved(scene, frame.inverse())

    def reopen(changed: Gaussians) -> Reopened:
        if len(changed) < len(model):
            raise WrongKeyError("this key opens nothing here")
        return Reopened(frame.inverse().apply_gaussians(changed), frame)

    rows = measure_robustness(model, [reopen], scene, [elsewhere], changes=[random_pruning(0.2)])
    (secret,) = rows[1].secrets
    assert not secret.opens
    assert secret.error == "this key opens nothing here"
    assert rows[1].cover is not None
    assert secret.psnr == pytest.approx(rows[1].cover.psnr, abs=0.01)
    with pytest.raises(UsageError, match="each of 1 secret"):
        measure_robustness(model, [], scene, [scene], changes=[])
    with pytest.raises(WrongKeyError):
        measure_robustness(model[:5], [reopen], scene, [elsewhere], changes=[])


def row(attack: str, strength: float, cover: float, *secrets: tuple[float, bool]) -> ChangeResult:
    shown = [ChangedQuality(30 - loss, 0.9, loss, opens) for loss, opens in ((cover, True), *secrets)]
    return ChangeResult(attack, strength, "u", "", 0, cover=shown[0], secrets=tuple(shown[1:]))


@pytest.mark.parametrize(
    ("losses", "first", "secret_at", "cover_at", "excess"),
    [
        ([(1, 2), (3, 6.5), (7, 9)], "secret", 1, 2, 3.5),
        ([(1, 0), (6, 5), (7, 9)], "cover", 2, 1, -1),
        ([(1, 2), (7, 6)], "both", 1, 1, 1),
        ([(1, 2), (3, 3.5)], "neither", None, None, 1),
        ([(8, 9)], "both", 0, 0, None),
    ],
)
def test_breakdown_points(
    losses: list[tuple[float, float]],
    first: First,
    secret_at: int | None,
    cover_at: int | None,
    excess: float | None,
) -> None:
    rows = [row("a", strength, cover, (secret, True)) for strength, (cover, secret) in enumerate(losses)]
    (found,) = breakdown_points([row("none", 0, 0, (0, True)), *rows])
    curve = tuple(StrengthLosses(strength, *pair) for strength, pair in enumerate(losses))
    assert found == BreakdownPoint("a", "u", curve, secret_at, cover_at, first, excess)


def test_breakdown_takes_means_of_draws_the_worst_of_secrets_and_what_does_not_open_as_broken() -> None:
    rows = [
        row("a", 1, 1, (0, True), (4, True)),
        row("a", 1, 2, (2, True), (1, True)),
        row("b", 1, 0, (0.1, False), (0, True)),
    ]
    first, second = breakdown_points(rows)
    assert first.losses == (StrengthLosses(1, 1.5, 3),)
    assert (first.excess, first.first) == (1.5, "neither")
    assert (second.secret, second.first) == (1, "secret")
    assert [point.first for point in breakdown_points(rows, broken_loss=3)] == ["secret", "secret"]


def test_draws_are_taken_together() -> None:
    rows = [row("a", 1, 1, (0, True), (4, True)), row("a", 2, 9), row("a", 1, 2, (2, True), (1, False))]
    first, second = mean_over_draws(rows)
    assert (first.draws, second.draws) == (2, 1)
    assert second == rows[1]
    assert first.cover is not None
    assert first.cover.loss == 1.5
    assert [(each.loss, each.psnr, each.opens) for each in first.secrets] == [
        (1, 29, True),
        (2.5, 27.5, False),
    ]
    skipped = replace(rows[1], cover=None, skipped="no tool")
    assert mean_over_draws([skipped]) == [skipped]


def test_the_default_changes_are_those_of_the_papers_and_more(scene: Scene) -> None:
    changes = default_changes(scene, seed=7)
    pruned = [0.05, 0.10, 0.15, 0.25, 0.50]
    assert [each.strength for each in changes if each.attack == "pruning by opacity"] == pruned
    assert sorted({each.strength for each in changes if each.attack == "random pruning"}) == pruned
    assert len({(each.attack, each.strength, each.seed) for each in changes}) == len(changes)
    assert all(each.sentence.endswith(".") for each in changes)
    attacks = [each.attack for each in changes]
    assert {f"noise on {attribute}" for attribute in NOISY} < set(attacks)
    assert {"purification", "fine-tuning", "cropping", "half floats", "fewer harmonics"} < set(attacks)
    # One after another: each attack's are together.
    assert sum(a != b for a, b in pairwise(attacks)) + 1 == len(set(attacks))


# --- secrets that are really there -----------------------------------------------------------------------


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(
        torch.equal(value, other) for value, other in zip(vars(a).values(), vars(b).values(), strict=True)
    )


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = three_scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


@pytest.mark.parametrize("publish", ["ply", "any"])
def test_a_refitted_secret_without_low_bits(
    publish: Literal["ply", "any"], pair: tuple[list[Scene], list[Gaussians]]
) -> None:
    scenes, models = pair
    config = CarryOptions(
        fit=replace(TINY, iterations=5, max_gaussians=2000), publish=publish, refit="always"
    )
    hidden = hide_scenes(scenes, [KEY], config, plains=models)
    reopen = Reopener(KEY, open_model)
    assert KEY not in repr(reopen)
    revealed = keyss.reveal(hidden.stego, KEY).gaussians
    assert same(reopen(hidden.stego).gaussians, revealed)

    changes = [random_pruning(0.1), half_floats(), purification(scenes[0], steps=0)]
    _, pruned, rounded, purified = measure_robustness(
        hidden.stego, [reopen], scenes[0], scenes[1:], changes=changes
    )
    if publish == "any":
        again = revealed  # all of it, or nothing
    else:
        with pytest.warns(KeyssWarning, match="of 200 Gaussians"):
            again = keyss.reveal(changes[0](hidden.stego), KEY).gaussians
    assert pruned.secrets[0].opens
    assert pruned.secrets[0].psnr == mean_psnr(again, scenes[1].test, scenes[1].background)
    assert rounded.secrets[0].opens == (publish == "any")
    if publish == "any":
        assert rounded.secrets[0].loss == 0
    else:
        assert rounded.secrets[0].error == "this key opens nothing here"
        assert rounded.secrets[0].loss > 10
    assert purified.cover is not None
    assert abs(purified.cover.loss) < 0.1
    assert purified.secrets[0].loss > 10  # nothing of the secret is seen in the cover


def test_pruning_a_carried_model_costs_what_it_must() -> None:
    """A Gaussian of the secret is lost with its carrier, unless there is a copy on another."""
    cover, secret, share = trained_like(3000), trained_like(1200, seed=1), 0.25
    stego = embed(cover, [(KEY, secret)])
    (layout,) = LOW_BITS.prepare(cover).plan_records([record_request(1200, 3)])
    expected = (1200 - layout.copies) * (1 - share) + layout.copies * (1 - share**2)
    reopen = Reopener(KEY, open_model)
    left = reopen(random_pruning(share)(stego)).gaussians
    assert abs(len(left) - expected) < 5 * (1200 * share * (1 - share)) ** 0.5
    whole = reopen(stego).gaussians
    assert len(whole) == 1200
    assert left.opacities.mean() > whole.opacities.mean() + 0.02  # makes up for those that are lost
    with pytest.raises(WrongKeyError):
        reopen(noise("harmonics", 1e-4)(stego))
    assert len(reopen(noise("colour", 0.1)(stego)).gaussians) == 1200  # carries nothing
