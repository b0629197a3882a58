"""KeySS training on tiny scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from keyss import KeyssOptions, WrongKeyError
from keyss.channels import is_appended
from keyss.core import InputError, KeyssWarning, UsageError
from keyss.core.similarity import Similarity
from keyss.fitting import save_checkpoint
from keyss.fitting.losses import Target, ssim_torch
from keyss.methods import DESIGNS, CombinedPoses, KeyssTraining, PlacedScene, Source, registry
from keyss.rendering import render
from methods.hiding import Hidden, check_resumes, hide_scenes, three_scenes
from methods.keyss.small import FIT, KEYS, VECTORS, small
from tiny_scenes import random_gaussians, tiny_scene


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    scenes, models = three_scenes()
    return hide_scenes(scenes, KEYS, small("published"), plains=models)


def _scenes() -> list[PlacedScene]:
    return [PlacedScene.of(tiny_scene(each), random_gaussians(seed=each), Similarity()) for each in range(3)]


def _run(design: str = "published", **changes: Any) -> KeyssTraining:
    options = small(design, **changes)
    options = options.with_fit(ssim_weight=options.configuration.ssim_weight)
    scenes = _scenes()
    return KeyssTraining(scenes, list(VECTORS[:2]), options, torch.device("cpu"))


def _loss(image: torch.Tensor, target: torch.Tensor, weight: float) -> torch.Tensor:
    return (1 - weight) * (image - target).abs().mean() + weight * (1 - ssim_torch(image, Target.of(target)))


@pytest.mark.parametrize(("design", "weight"), [("published", 0.5), ("released", 0.2)])
def test_equation_11(design: str, weight: float) -> None:
    run = _run(design, beta_cover=0.7, beta_secret=0.3, beta_incorrect=0.2)
    pose = (1, 4)
    camera, cover = run.poses.camera(*pose), run.cover()
    black = torch.zeros(3)
    models = [cover, run.decoder(cover, VECTORS[0]), run.decoder(cover, VECTORS[1])]
    if design == "released":
        seen = run.visible_rows(cover, camera)
        models[1:] = [model[seen] for model in models[1:]]
    targets = [run.poses.target(scene, *pose).image for scene in range(3)]
    images = [render(model.with_sh_degree(0), camera, black) for model in models]
    wrong = render(run.decoder(cover, VECTORS[2]).with_sh_degree(0), camera, black)
    parts = [_loss(*pair, weight) for pair in zip(images, targets, strict=True)]
    expected = 0.7 * parts[0] + 0.3 * (parts[1] + parts[2]) + 0.2 * _loss(wrong, targets[0], weight)
    total, renders = run.losses([pose] * 3, VECTORS[2])
    torch.testing.assert_close(total, expected, rtol=1e-4, atol=1e-5)
    assert [render[2] for render in renders] == ([1.0] * 3 if design == "released" else [0.7, 0.3, 0.3])


def test_reveal_in_cover_frame(hidden: Hidden) -> None:
    scenes, _ = three_scenes()
    own = hidden.opened[0].reveal(hidden.stego)
    there = hidden.opened[0].reveal(hidden.stego, frame="cover")
    frame = hidden.opened[0].frame
    assert frame is not None
    assert frame.scale != pytest.approx(1, abs=0.1)
    camera = scenes[1].test[0].camera
    difference = render(own, camera) - render(there, frame.apply_camera(camera))
    # Single pixels at the border of a Gaussian may differ.
    assert difference.abs().mean() < 1e-4


def test_keys(hidden: Hidden) -> None:
    for key, secret in zip(KEYS, hidden.opened, strict=True):
        assert registry.open_model(hidden.stego, key).fingerprint() == secret.fingerprint()
    for key in ("First key", "other"):
        with pytest.raises(WrongKeyError):
            registry.open_model(hidden.stego, key)


def test_appended_gaussians_are_not_decoded(hidden: Hidden) -> None:
    own = hidden.stego[~is_appended(hidden.stego)]
    assert len(own) < len(hidden.stego) - 1000
    for secret in hidden.opened:
        revealed = secret.reveal(hidden.stego)
        assert revealed.digest() == secret.reveal(own).digest()
        assert secret.recovered(revealed).whole
        assert len(revealed) > 100


def test_moved_model(hidden: Hidden) -> None:
    for other in (replace(hidden.stego, means=hidden.stego.means + 1e-2), random_gaussians(seed=9)):
        with pytest.raises(InputError, match="moved or rounded"):
            hidden.opened[0].reveal(other)


def test_note_on_a_small_cover() -> None:
    inputs, options = [Source(model, photos=True) for model in three_scenes()[1]], KeyssOptions(fit=FIT)
    notes, enough = (
        "; ".join(registry.get("keyss").prepare(inputs[:2], each).plan.notes)
        for each in (options, options.with_fit(max_gaussians=20_000))
    )
    assert "600 Gaussians is probably too small for low bits" in notes
    assert "too small" not in enough


def test_targets() -> None:
    scenes, models = three_scenes()
    mask = torch.ones(scenes[1].train[3].image.shape[:2], dtype=torch.bool)
    mask[:3, :4] = False
    masked = tuple(replace(view, mask=mask) for view in scenes[1].train)
    scenes[1] = replace(scenes[1], train=masked)
    frame = Similarity(0.5, torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    placed = [
        PlacedScene.of(scenes[0], models[0], Similarity()),
        PlacedScene.of(scenes[1], models[1], frame),
    ]
    poses = CombinedPoses(placed, torch.device("cpu"))
    own = poses.target(1, owner=1, index=3)
    assert torch.equal(own.image[mask], scenes[1].train[3].image[mask].float() / 255)
    # The transformed model matches the photo from the transformed camera.
    rendered = render(placed[1].plain, poses.camera(1, 3)).clamp(0, 1)
    assert (rendered - own.image)[mask].abs().mean() < 4e-3
    assert own.mask is not None
    assert torch.equal(own.mask, mask)
    foreign = poses.target(0, owner=1, index=3)
    assert foreign.mask is None  # masks apply to their own scene only
    expected = render(models[0], poses.camera(1, 3)).clamp(0, 1)
    assert (foreign.image - expected).abs().max() <= 0.5 / 255 + 1e-6


def test_combined_poses() -> None:
    """One pose for all scenes; every pose of every scene comes once before one returns."""
    scenes, models = three_scenes()
    scenes[1] = replace(scenes[1], train=scenes[1].train[:3])
    placed = [PlacedScene.of(*each, Similarity()) for each in zip(scenes, models, strict=True)]
    run = KeyssTraining(placed, list(VECTORS[:2]), small("published", common_poses=1.0), torch.device("cpu"))
    poses = [(scene, index) for scene, each in enumerate(scenes) for index in range(len(each.train))]
    drawn = [run.sample_poses() for _ in poses]
    assert all(len(set(each)) == 1 for each in drawn)
    assert sorted(each[0] for each in drawn) == poses


def test_each_scene_has_its_own_photos_between_common_poses() -> None:
    run = _run(common_poses=0.25)
    drawn = [run.sample_poses() for _ in range(400)]
    photos = [pose for pose in drawn if [owner for owner, _ in pose] == [0, 1, 2]]
    assert all(len(set(pose)) == 1 for pose in drawn if pose not in photos)
    assert 240 <= len(photos) <= 350  # binomial: 300 +- 9
    run = _run(common_poses=0.0, poses="cover")  # a scene whose poses do not count never has its own
    assert {owner for _ in range(30) for owner, _ in run.sample_poses()} == {0}


def test_start_leaves_room_for_growth() -> None:
    scenes = [tiny_scene(seed) for seed in range(3)]
    run = _run()
    assert run.started == len(run) == min(FIT.max_gaussians // 3, sum(len(scene.points) for scene in scenes))
    # As wide as the distance to neighbours of any scene (combined SfM points).
    means, widths = run.parameters["means"].detach(), run.parameters["scales"].detach().exp()[:, 0]
    nearest = torch.cdist(means, means).topk(4, largest=False).values[:, 1:]
    torch.testing.assert_close(widths, nearest.square().mean(1).sqrt(), rtol=1e-3, atol=1e-4)


def test_scene_without_points_starts_from_its_plain_model() -> None:
    scenes = _scenes()
    bare = replace(scenes[1].scene, points=torch.empty(0, 3), colors=torch.empty(0, 3, dtype=torch.uint8))
    scenes[1] = replace(scenes[1], scene=bare)
    run = KeyssTraining(scenes, list(VECTORS[:2]), small("published"), torch.device("cpu"))
    means = run.parameters["means"].detach()
    for scene, points in enumerate((scenes[0].scene.points, scenes[1].plain.means, scenes[2].scene.points)):
        own = means[run.scene_of_point == scene]
        assert len(own) >= 40
        assert {tuple(point) for point in own.tolist()} <= {tuple(point) for point in points.tolist()}


def test_pretrained_decoder_shows_each_scene_its_own_points() -> None:
    run = KeyssTraining(_scenes()[:2], list(VECTORS[:1]), KeyssOptions(fit=FIT), torch.device("cpu"))
    cover = run.cover().detach()
    with torch.no_grad():
        secret, wrong = run.secret(cover, 1), run.decoder(cover, VECTORS[2])
    for scene, model in enumerate((cover, secret)):
        own = run.scene_of_point == scene
        assert model.opacities[own].median() > 0.08
        assert model.opacities[~own].median() < 0.01
    torch.testing.assert_close(wrong.opacities, cover.opacities, atol=0.03, rtol=0)


@pytest.mark.parametrize(("iterations", "boost"), [(60, 5.0), (30_000, 1.0)])
def test_decoder_rate_follows_the_length_of_the_run(iterations: int, boost: float) -> None:
    run = _run(fit=replace(FIT, iterations=iterations))
    run.iteration = iterations
    run.set_rates()
    assert run.network_optimizer.param_groups[0]["lr"] == pytest.approx(5e-4 * boost * 0.05)


def test_idle_density_control_warns() -> None:
    scenes, models = three_scenes()
    options = small("published").with_fit(grow_gradient=1e9, iterations=10)
    with pytest.warns(KeyssWarning, match="density control added no Gaussian"):
        hide_scenes(scenes[:2], KEYS[:1], options, plains=models[:2])


@pytest.mark.parametrize("which", ["cover", "secret"])
def test_scene_subsets(which: Any) -> None:
    run = _run(points=which, poses=which, densification=which)
    owners = {pose[0] for _ in range(30) for pose in run.sample_poses()}
    assert owners == ({0} if which == "cover" else {1, 2})
    run.step()


@pytest.mark.parametrize("design", ["published", "released"])
def test_resume(tmp_path: Path, design: str) -> None:
    options = small(design).with_fit(iterations=40, grow_every=5)
    check_resumes(options, tmp_path, "hide", three_scenes()[1][:2])


def test_state_after_growth_can_be_saved(tmp_path: Path) -> None:
    run = _run()
    while run.iteration < FIT.refine_every:
        run.step()
    assert len(run) > run.started
    save_checkpoint(tmp_path / "state", run.state(), {})


def test_invalid_options() -> None:
    for wrong, message in (
        ({"publish": "converted"}, "bit for bit"),
        ({"design": "carriers"}, r"`carriers`|'carriers'.*published, released"),
        ({"mask": ()}, "none"),
        ({"mask": ("op", "colour")}, "colour"),
        ({"clip_model": "folder"}, "key_encoder"),
    ):
        with pytest.raises(UsageError, match=message):
            KeyssOptions(**wrong)  # type: ignore[arg-type]
    shares = {"common_poses": 1.5}, {"start_share": 1.0}
    for change in ({"beta_secret": 0.0}, {"decoder_rate": 0.0}, {"pretraining": -1}, *shares):
        with pytest.raises(UsageError, match=next(iter(change))):
            replace(DESIGNS["published"], **change)
