"""Hiding tiny scenes, all the way: the same code as for real ones, in seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from keyss import FitConfig, Gaussians, KeyssOptions, WrongKeyError
from keyss.channels import is_appended
from keyss.core import InputError, KeyssWarning, UsageError, same_bits
from keyss.core.similarity import Similarity
from keyss.fitting import make_optimizers, to_parameters
from keyss.fitting.density import combine_densification
from keyss.keys import random_embeddings
from keyss.methods import CombinedPoses, PlacedScene, Source, registry
from keyss.methods.keyss import method
from keyss.methods.keyss.designs.network import EvenGrowth, possibly_seen
from keyss.rendering import render, render_with_meta
from keyss.rendering.orbit import orbit
from methods.hiding import Hidden, check_resumes, hide_scenes, psnr_in, three_scenes
from methods.keyss.hiding import KEYS, OPTIONS, PUBLISHED, SMALL
from tiny_scenes import random_gaussians, tiny_scene


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    scenes, models = three_scenes()
    config = replace(OPTIONS, fit=replace(OPTIONS.fit, iterations=200))
    return hide_scenes(scenes, KEYS, config, plains=models)


def test_the_published_model_shows_the_cover(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    assert int((~is_appended(hidden.stego)).sum()) <= OPTIONS.fit.max_gaussians
    for other in scenes[1:]:
        assert psnr_in(hidden.stego, other) < psnr_in(hidden.stego, scenes[0]) - 1


@pytest.mark.parametrize("secret", [1, 2])
def test_each_key_opens_its_secret_in_its_own_frame(hidden: Hidden, secret: int) -> None:
    scenes, _ = three_scenes()
    revealed = hidden.opened[secret - 1].reveal(hidden.stego)
    assert psnr_in(revealed, scenes[secret]) > psnr_in(hidden.stego, scenes[secret]) + 4


def test_frame_cover_leaves_the_secret_where_it_was_hidden(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    own = hidden.opened[0].reveal(hidden.stego)
    there = hidden.opened[0].reveal(hidden.stego, frame="cover")
    frame = hidden.opened[0].frame
    assert frame.scale != pytest.approx(1, abs=0.1)
    camera = scenes[1].test[0].camera
    difference = render(own, camera) - render(there, frame.apply_camera(camera))
    assert difference.abs().max() < 2e-3


def test_keys_open_their_own_and_wrong_ones_nothing(hidden: Hidden) -> None:
    for key, secret in zip(KEYS, hidden.opened, strict=True):
        opened = registry.open_model(hidden.stego, key)
        assert torch.equal(opened.embedding, secret.embedding)
    for key in ("First key", "other"):
        with pytest.raises(WrongKeyError):
            registry.open_model(hidden.stego, key)


def test_an_embedding_of_no_key_shows_the_cover(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    for embedding in random_embeddings(2, torch.Generator().manual_seed(5)):
        decoy = hidden.opened[0].decode(hidden.stego, embedding)
        assert psnr_in(decoy, scenes[0]) == pytest.approx(psnr_in(hidden.stego, scenes[0]), abs=0.1)
        assert psnr_in(decoy, scenes[2]) < psnr_in(hidden.stego, scenes[2]) + 1


def test_appended_gaussians_are_not_decoded(hidden: Hidden) -> None:
    own = hidden.stego[~is_appended(hidden.stego)]
    assert len(own) < len(hidden.stego) - 1000
    for secret in hidden.opened:
        assert same_bits(secret.reveal(hidden.stego), secret.reveal(own))
        assert secret.remains(secret.reveal(hidden.stego)).whole


def test_decoders_that_will_be_appended_are_told_of_before_any_work() -> None:
    inputs = [Source(model, photos=True) for model in three_scenes()[1]]
    with pytest.warns(KeyssWarning, match=r"600 Gaussians is too small.*in appended Gaussians"):
        registry.get("keyss").prepare(inputs, OPTIONS)
    registry.get("keyss").prepare(inputs[:2], OPTIONS.with_fit(max_gaussians=6000))


def test_revealing_survives_order_and_pruning_and_refuses_another_model(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    chosen = torch.randperm(len(hidden.stego), generator=torch.Generator().manual_seed(0))
    shuffled = hidden.opened[1].reveal(hidden.stego[chosen])
    assert psnr_in(shuffled, scenes[2]) == pytest.approx(
        psnr_in(hidden.opened[1].reveal(hidden.stego), scenes[2]), abs=0.1
    )
    hidden.opened[1].reveal(hidden.stego[chosen[: len(chosen) // 2]])
    with pytest.raises(InputError, match="another one"):
        hidden.opened[1].reveal(random_gaussians(seed=9))
    hidden.opened[1].reveal(random_gaussians(seed=9), force=True)


def test_targets_are_photos_where_there_are_and_renders_elsewhere() -> None:
    scenes, models = three_scenes()
    frame = Similarity(0.5, torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    placed = [
        PlacedScene.of(scenes[0], models[0], Similarity()),
        PlacedScene.of(scenes[1], models[1], frame),
    ]
    poses = CombinedPoses(placed, torch.device("cpu"))
    own = poses.target(1, owner=1, index=3)
    assert torch.equal(own.image, scenes[1].train[3].image.float() / 255)
    # The model moved into the cover's frame shows from a moved camera what its photo shows.
    rendered = render(placed[1].plain, poses.camera(1, 3)).clamp(0, 1)
    assert (rendered - own.image).abs().mean() < 4e-3
    foreign = poses.target(0, owner=1, index=3)
    expected = render(models[0], poses.camera(1, 3)).clamp(0, 1)
    assert (foreign.image - expected).abs().max() <= 0.5 / 255 + 1e-6


def test_combined_densification_scatters_and_unweights() -> None:
    def meta(gradient: list[list[float]], radii: list[list[int]]) -> dict[str, object]:
        means2d = torch.zeros(1, len(gradient), 2, requires_grad=True)
        means2d.grad = torch.tensor([gradient], dtype=torch.float32)
        return {"means2d": means2d, "radii": torch.tensor([radii]), "width": 4, "height": 3}

    cover = meta([[1, 2], [3, 4], [5, 6]], [[1, 1], [0, 0], [2, 2]])
    secret = meta([[7, 8]], [[3, 3]])
    combined = combine_densification([(cover, None, 0.5), (secret, torch.tensor([1]), 0.25)], 3)
    assert combined["means2d"].grad.tolist() == [
        [[2, 4], [6, 8], [10, 12]],
        [[0, 0], [28, 32], [0, 0]],
    ]
    assert combined["radii"].tolist() == [[[1, 1], [0, 0], [2, 2]], [[0, 0], [3, 3], [0, 0]]]


@pytest.mark.parametrize("which", ["cover", "secret"])
def test_points_poses_and_densification_can_be_of_some_scenes_only(which: Any) -> None:
    scenes, models = three_scenes()
    fit = replace(OPTIONS.fit, iterations=12, grow_every=4)
    config = replace(PUBLISHED, fit=fit, points=which, poses=which, densification=which)
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in zip(scenes, models, strict=True)]
    embeddings = list(random_embeddings(2, torch.Generator()))
    run = config.settings.training(placed, embeddings, config, torch.device("cpu"))
    owners = {pose[0] for _ in range(30) for pose in run._sample_poses()}
    assert owners == ({0} if which == "cover" else {1, 2})
    run.step()


@pytest.mark.parametrize("options", [OPTIONS, replace(PUBLISHED, residuals="one-sided")])
def test_an_interrupted_training_resumes_to_the_same_result(tmp_path: Path, options: KeyssOptions) -> None:
    options = replace(options, fit=replace(OPTIONS.fit, iterations=40, grow_every=5))
    check_resumes(options, tmp_path, "hide")


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(UsageError, match="bit for bit"):
        KeyssOptions(publish="any")
    with pytest.raises(UsageError, match="common_poses"):
        KeyssOptions(design="mlp", poses="cover")
    KeyssOptions(poses="cover", design="published")
    for change in ({"key_encoder": "clip"}, {"points": "cover"}, {"densification": "secret"}):
        with pytest.raises(UsageError, match="carriers"):
            KeyssOptions(design="carriers", **change)  # type: ignore[arg-type]


def test_options_override_the_design() -> None:
    options = KeyssOptions(design="published", mask=("op",), common_poses=0.5)
    for name in ("published", "mlp"):
        chosen = KeyssOptions(design=name).settings
        assert replace(options, design=name).settings == replace(chosen, mask=("op",), common_poses=0.5)
    assert options.settings.shape(3).hidden == (64, 128)
    with pytest.raises(UsageError, match="`mask`: the design carriers has no such setting"):
        replace(options, design="carriers")


@pytest.mark.parametrize("design", ["published", "released"])
def test_the_published_designs_train(design: Any) -> None:
    """A few steps: everything that they switch on runs, and the result is finite."""
    scenes, models = three_scenes()
    options = KeyssOptions(design=design, fit=replace(OPTIONS.fit, iterations=12, grow_every=4), **SMALL)
    hidden = hide_scenes(scenes, KEYS, options, plains=models)
    for secret in hidden.opened:
        revealed = secret.reveal(hidden.stego)
        assert 0 < len(revealed) <= len(hidden.stego)
        assert all(getattr(revealed, f.name).isfinite().all() for f in fields(Gaussians))


def test_decoders_are_appended_rather_than_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """How many carriers there will be is not known before the training."""

    class Unusable:
        prepare: Callable[[Gaussians], None]

        def __init__(self) -> None:
            def refuse(model: Gaussians) -> None:
                raise InputError("no low bits")

            self.prepare = refuse

    monkeypatch.setattr(method, "LOW_BITS", Unusable())
    scenes = [tiny_scene(seed) for seed in range(2)]
    fit = FitConfig(iterations=2, max_gaussians=6000)
    options = KeyssOptions(design="mlp", hidden=(8, 8), branch=8, fit=fit)
    plains = [random_gaussians(seed=seed) for seed in range(2)]
    hidden = hide_scenes(scenes, KEYS[:1], options, plains=plains)
    assert is_appended(hidden.stego).any()
    revealed = registry.open_model(hidden.stego, KEYS[0]).reveal(hidden.stego)
    assert revealed.means.isfinite().all()


def test_free_places_go_to_the_scene_that_has_fewer_gaussians() -> None:
    """Although the gradients of the other scene are larger."""
    model = replace(random_gaussians(60), log_scales=torch.full((60, 3), -9.0))
    few = torch.arange(60) < 10
    opacities = torch.stack([(~few).float(), few.float()], dim=1)
    growth = EvenGrowth(FitConfig(max_gaussians=100), lambda: opacities, 2)
    parameters = to_parameters(model, torch.device("cpu"))
    state = growth.initialize_state(1.0)
    state |= {"grad2d": torch.stack([1.0 * ~few, 0.5 * few], dim=1), "count": torch.ones(60, 2)}
    growth._grow_gs(parameters, make_optimizers(parameters, FitConfig(), 1.0), state, 1)
    assert torch.equal(parameters["means"][60:], model.means[:10])
    assert state["grad2d"].shape == (70, 2)


def test_at_the_cap_what_no_scene_shows_makes_room() -> None:
    model = replace(random_gaussians(60), log_scales=torch.full((60, 3), -9.0))
    opacities = torch.tensor([[0.9, 0.0], [0.0, 0.9], [0.01, 0.04]]).repeat_interleave(20, 0)
    growth = EvenGrowth(FitConfig(max_gaussians=60), lambda: opacities, 2)
    parameters = to_parameters(model, torch.device("cpu"))
    state = growth.initialize_state(1.0) | {"grad2d": opacities.clone(), "count": torch.ones(60, 2)}
    growth._grow_gs(parameters, make_optimizers(parameters, FitConfig(), 1.0), state, 1)
    assert torch.equal(parameters["means"][:40], model.means[:40])
    for scene in (model.means[:20], model.means[20:40]):
        assert int((parameters["means"][40:, None] == scene).all(2).any(1).sum()) == 10


@pytest.mark.parametrize("change", [{}, {"conditioning": "bias"}, {"mask": ("sc",)}, {"points": "cover"}])
def test_scenes_start_apart_where_decoders_can_tell_them(change: dict[str, Any]) -> None:
    """Each decoder shows its secret's points, as plain 3DGS starts with them, and nothing else."""
    scenes, models = three_scenes()
    options = replace(OPTIONS, common_poses=1.0, **change)
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in zip(scenes, models, strict=True)]
    embeddings = list(random_embeddings(2, torch.Generator()))
    opacities = options.settings.training(placed, embeddings, options, torch.device("cpu")).opacities()
    if change:
        assert torch.allclose(opacities, torch.tensor(0.1))
    else:
        shown = opacities > 1e-6
        assert torch.allclose(opacities[shown], torch.tensor(0.1), atol=1e-3)
        assert shown.sum(1).eq(1).all()
        assert shown.sum(0).min() > len(shown) / 4


@pytest.mark.parametrize("slack", [0.0, 0.5])
def test_what_a_view_shows_may_be_seen_and_what_lies_far_aside_may_not(slack: float) -> None:
    """No Gaussian that a view shows is left out, even after a decoder moved it."""
    generator = torch.Generator().manual_seed(0)
    model = random_gaussians(400)
    camera = replace(orbit(model, 48, 4)[3], width=24, height=24)  # a corner: much lies outside
    seen = set(possibly_seen(model, camera, slack).tolist())
    assert 0 < len(seen) < len(model)
    for _ in range(5):
        steps = torch.nn.functional.normalize(torch.randn(len(model), 3, generator=generator), dim=1)
        _, meta = render_with_meta(replace(model, means=model.means + slack * steps), camera)
        drawn = (meta["radii"][0] > 0).all(-1).nonzero()[:, 0].tolist()
        assert drawn
        assert seen.issuperset(drawn)
