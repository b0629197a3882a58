"""Changes of published models: that each does what it says, and what is told of what it costs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import keyss
from files.test_ply import splat_transform
from hiding.test_joint import CONFIG, _moved, _scenes
from keyss.carry import embed
from keyss.carry.plan import Size, plan
from keyss.core import BackendError, Gaussians, Scene, UsageError, WrongKeyError
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import mean_psnr, quality
from keyss.hiding.payload import choose_anchors
from keyss.hiding.pipeline import hide_scenes
from keyss.measure.robustness import (
    Change,
    Opened,
    Reopener,
    converters,
    default_changes,
    robustness,
    verdicts,
)
from keyss.measure.robustness.changes import (
    NOISY,
    cropping,
    fewer_harmonics,
    half_floats,
    noise,
    opacity_pruning,
    random_pruning,
)
from keyss.measure.robustness.conversions import Converter
from keyss.measure.robustness.retraining import fine_tuning, purification, refined, unused
from keyss.seal.low_bits import is_random
from seal.trained_like import trained_like
from tiny_scenes import random_gaussians, tiny_scene

__all__ = ["splat_transform"]  # a fixture

KEY = "the right key"


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(
        torch.equal(value, other) for value, other in zip(vars(a).values(), vars(b).values(), strict=True)
    )


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
    assert same(left, model[place])
    assert same(left, random_pruning(share, seed=3)(model))
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
    anchors = choose_anchors(model, torch.Generator().manual_seed(0))
    left = torch.cdist(anchors, random_pruning(0.5, seed=0)(model).means).amin(1) == 0
    assert 0.2 < float(left.float().mean()) < 0.8


def test_pruning_by_opacity_removes_the_lowest() -> None:
    model = random_gaussians(200)
    left = opacity_pruning(0.15)(model)
    assert torch.equal(left.opacity_logits.sort().values, model.opacity_logits.sort().values[30:])
    assert same(left, model[model.opacity_logits >= left.opacity_logits.min()])


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
    assert same(changed, noise(attribute, 0.1, seed=1)(model))
    assert not same(changed, noise(attribute, 0.1, seed=2)(model))
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
    """The scene's model among others of which no photo shows anything, and which those are."""
    seen = random_gaussians(seed=0)
    transparent = replace(random_gaussians(30, seed=1), opacity_logits=torch.full((30,), -8.0))
    elsewhere = replace(random_gaussians(20, seed=2), means=torch.tensor([0, 0, 90.0]).repeat(20, 1))
    model = Gaussians.cat([transparent, seen, elsewhere])
    invisible = torch.zeros(len(model), dtype=torch.bool)
    invisible[:30] = invisible[-20:] = True
    return model, invisible


def test_purification_removes_what_is_not_seen_and_nothing_else(scene: Scene) -> None:
    model, invisible = planted()
    assert torch.equal(unused(model, scene), invisible)
    purified = purification(scene, steps=0)(model)
    assert same(purified, model[~invisible])
    assert mean_psnr(purified, scene.test, scene.background) == pytest.approx(
        mean_psnr(model, scene.test, scene.background), abs=1e-3
    )


def test_purification_can_give_up_what_is_hardly_seen(scene: Scene) -> None:
    model, invisible = planted()
    faint = model.opacity_logits.clone()
    faint[:30] = -5.0  # 1/150: just drawn
    model = replace(model, opacity_logits=faint)
    assert int(unused(model, scene)[:30].sum()) < 15
    assert torch.equal(unused(model, scene, 0.01)[:30], invisible[:30])
    assert int(unused(model, scene, 0.01)[30:-20].sum()) < 60
    assert len(purification(scene, 1.0, steps=0)(model)) == 1  # never all of them


def test_training_on_repairs_what_photos_show_and_leaves_what_they_do_not(scene: Scene) -> None:
    model, invisible = planted()
    spoilt = noise("colour", 0.3)(model)
    tuned = fine_tuning(scene, steps=60)(spoilt)
    before, after = (mean_psnr(each, scene.train, scene.background) for each in (spoilt, tuned))
    assert after > before + 3
    assert same(tuned[invisible], spoilt[invisible])
    assert same(tuned, fine_tuning(scene, steps=60)(spoilt))
    assert same(refined(spoilt, scene, 0), spoilt)


# --- conversions -----------------------------------------------------------------------------------------


def by(format: str, tool: str) -> Converter:
    (found,) = (each for each in converters() if (each.format, each.tool) == (format, tool))
    return found


def test_gsply_spz_rounds_as_the_format_says() -> None:
    """Version 3 by Niantic's description: positions in steps of 2^-12, opacities in steps of 1/255."""
    model = random_gaussians(300)
    converted = by(".spz", "gsply")(model)
    back = converted.gaussians
    assert len(back) == 300
    assert 0 < converted.bytes < 300 * 100
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
    assert same(back, by("compressed .ply", "gsply").change()(model))


@pytest.mark.parametrize("format", ["compressed .ply", ".spz", ".splat", ".sog"])
def test_splat_transform_converts(format: str, splat_transform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", splat_transform)
    model = random_gaussians(60)
    back = by(format, "splat-transform")(model).gaussians
    assert len(back) == 60
    assert float(torch.cdist(back.means, model.means).amin(1).max()) < 0.01
    assert back.sh_degree == (0 if format == ".splat" else 3)


def test_an_absent_tool_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Scene) -> None:
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tmp_path / "nowhere"))
    model, change = random_gaussians(seed=0), by(".sog", "splat-transform").change()
    with pytest.raises(BackendError, match="npm install"):
        change(model)
    rows = robustness(model, [Opened], scene, [scene], changes=[change, half_floats()])
    assert "splat-transform is not installed" in rows[1]["skipped"]
    assert "cover" not in rows[1]
    assert "skipped" not in rows[2]
    assert [verdict["attack"] for verdict in verdicts(rows)] == ["half floats"]


def test_a_failing_tool_is_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tool = tmp_path / "splat-transform"
    tool.write_text("#!/bin/sh\necho 'out of luck' >&2\nexit 1\n")
    tool.chmod(0o755)
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tool))
    with pytest.raises(BackendError, match="out of luck"):
        by(".spz", "splat-transform")(random_gaussians(5))


# --- what changes cost -----------------------------------------------------------------------------------


def test_losses_are_differences_of_quality(scene: Scene) -> None:
    """The secret is the cover, so that all is known."""
    model = random_gaussians(seed=0)
    changes = [random_pruning(0.5, seed) for seed in (0, 1)]
    steps: list[tuple[int, int, str]] = []
    rows = robustness(
        model, [Opened], scene, [scene], changes=changes, progress=lambda *step: steps.append(step)
    )
    assert [row["attack"] for row in rows] == ["none", "random pruning", "random pruning"]
    assert rows[0]["cover"]["loss"] == rows[0]["secrets"][0]["loss"] == 0
    before = quality(model, scene.test, scene.background)
    for row, change in zip(rows[1:], changes, strict=True):
        now = quality(change(model), scene.test, scene.background)
        assert row["cover"] == {"psnr": now.psnr, "ssim": now.ssim, "loss": before.psnr - now.psnr}
        assert row["secrets"] == [row["cover"] | {"opens": True}]
        assert row["gaussians"] == 100
    assert [step[:2] for step in steps] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert json.loads(json.dumps(rows)) == rows
    assert robustness(model, [Opened], scene, [scene], changes=changes) == rows


def test_views_are_bounded() -> None:
    scene, model = tiny_scene(0, views=16), random_gaussians(150, seed=0)
    (row,) = robustness(model, [], scene, [], changes=[], views=1)
    assert row["cover"]["psnr"] == mean_psnr(model, scene.test[:1], scene.background)


def test_what_is_lost_looks_like_the_cover_from_where_the_secret_is(scene: Scene) -> None:
    """The secret's cameras are the cover's in another frame, so that the floor is the cover's own quality."""
    model = random_gaussians(seed=0)
    frame = Similarity(2.0, translation=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    elsewhere = _moved(scene, frame.inverse())

    def reopen(changed: Gaussians) -> Opened:
        if len(changed) < len(model):
            raise WrongKeyError("this key opens nothing here")
        return Opened(frame.inverse().apply_gaussians(changed), frame)

    rows = robustness(model, [reopen], scene, [elsewhere], changes=[random_pruning(0.2)])
    (secret,) = rows[1]["secrets"]
    assert not secret["opens"]
    assert secret["error"] == "this key opens nothing here"
    assert secret["psnr"] == pytest.approx(rows[1]["cover"]["psnr"], abs=0.01)
    with pytest.raises(UsageError, match="each of 1 secret"):
        robustness(model, [], scene, [scene], changes=[])
    with pytest.raises(WrongKeyError):
        robustness(model[:5], [reopen], scene, [elsewhere], changes=[])


def row(attack: str, strength: float, cover: float, *secrets: tuple[float, bool]) -> dict[str, Any]:
    return {
        "attack": attack,
        "strength": strength,
        "unit": "u",
        "cover": {"loss": cover},
        "secrets": [{"loss": loss, "opens": opens} for loss, opens in secrets],
    }


@pytest.mark.parametrize(
    ("losses", "verdict", "secret_dies_at", "cover_dies_at", "excess"),
    [
        ([(1, 2), (3, 6.5), (7, 9)], "sooner", 1, 2, 3.5),
        ([(1, 0), (6, 5), (7, 9)], "later", 2, 1, -1),
        ([(1, 2), (7, 6)], "together", 1, 1, 1),
        ([(1, 2), (3, 3.5)], "neither", None, None, 1),
        ([(8, 9)], "together", 0, 0, None),
    ],
)
def test_verdicts(
    losses: list[tuple[float, float]],
    verdict: str,
    secret_dies_at: int | None,
    cover_dies_at: int | None,
    excess: float | None,
) -> None:
    rows = [row("a", strength, cover, (secret, True)) for strength, (cover, secret) in enumerate(losses)]
    (found,) = verdicts([row("none", 0, 0, (0, True)), *rows])
    assert found == {
        "attack": "a",
        "unit": "u",
        "curve": [[strength, cover, secret] for strength, (cover, secret) in enumerate(losses)],
        "secret_dies_at": secret_dies_at,
        "cover_dies_at": cover_dies_at,
        "excess": excess,
        "verdict": verdict,
    }


def test_verdicts_take_means_of_draws_the_worst_of_secrets_and_what_does_not_open_as_dead() -> None:
    rows = [
        row("a", 1, 1, (0, True), (4, True)),
        row("a", 1, 2, (2, True), (1, True)),
        row("b", 1, 0, (0.1, False), (0, True)),
    ]
    first, second = verdicts(rows)
    assert first["curve"] == [[1, 1.5, 3]]
    assert (first["excess"], first["verdict"]) == (1.5, "neither")
    assert (second["secret_dies_at"], second["verdict"]) == (1, "sooner")
    assert [verdict["verdict"] for verdict in verdicts(rows, dead=3)] == ["sooner", "sooner"]


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


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = _scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


@pytest.mark.parametrize("sidecar", [False, True])
def test_a_learned_secret_without_low_bits(sidecar: bool, pair: tuple[list[Scene], list[Gaussians]]) -> None:
    scenes, models = pair
    config = replace(CONFIG, fit=replace(CONFIG.fit, iterations=5, max_gaussians=2000))
    hidden = hide_scenes(scenes, [KEY], config, plains=models, sidecar=sidecar)
    reopen = Reopener(KEY, hidden.sidecar)
    assert KEY not in repr(reopen)
    revealed = keyss.reveal(hidden.stego, KEY, decoder=hidden.sidecar)
    assert same(reopen(hidden.stego).gaussians, revealed)

    changes = [random_pruning(0.1), half_floats(), purification(scenes[0], steps=0)]
    _, pruned, rounded, purified = robustness(hidden.stego, [reopen], scenes[0], scenes[1:], changes=changes)
    again = keyss.reveal(changes[0](hidden.stego), KEY, decoder=hidden.sidecar)
    assert pruned["secrets"][0]["opens"]
    assert pruned["secrets"][0]["psnr"] == mean_psnr(again, scenes[1].test, scenes[1].background)
    assert rounded["secrets"][0]["opens"] == sidecar
    if sidecar:
        assert rounded["secrets"][0]["loss"] < 0.5
    else:
        assert rounded["secrets"][0]["error"] == "this key opens nothing here"
        assert rounded["secrets"][0]["loss"] > 10
    assert abs(purified["cover"]["loss"]) < 0.1
    assert purified["secrets"][0]["loss"] > 10  # nothing of the secret is seen in the cover


def test_pruning_a_carried_model_costs_what_it_must() -> None:
    """A Gaussian of the secret is lost with its carrier, unless there is a copy on another."""
    cover, secret, share = trained_like(3000), trained_like(1200, seed=1), 0.25
    stego = embed(cover, [(KEY, secret)])
    (layout,) = plan([Size(1200, 3)], int(is_random(cover).sum()), 3000, 3)
    expected = (1200 - layout.copies) * (1 - share) + layout.copies * (1 - share**2)
    left = Reopener(KEY)(random_pruning(share)(stego)).gaussians
    assert abs(len(left) - expected) < 5 * (1200 * share * (1 - share)) ** 0.5
    whole = Reopener(KEY)(stego).gaussians
    assert len(whole) == 1200
    assert left.opacities.mean() > whole.opacities.mean() + 0.02  # makes up for those that are lost
    with pytest.raises(WrongKeyError):
        Reopener(KEY)(noise("harmonics", 1e-4)(stego))
    assert len(Reopener(KEY)(noise("colour", 0.1)(stego)).gaussians) == 1200  # carries nothing
