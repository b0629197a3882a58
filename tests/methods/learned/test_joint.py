"""Hiding tiny scenes, all the way: the same code as for real ones, in seconds."""

from __future__ import annotations

import os
import signal
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from keyss.channels.appended import is_appended
from keyss.core import Gaussians, InputError, KeyssWarning, Scene, UsageError, WrongKeyError
from keyss.core.similarity import Similarity
from keyss.fitting.config import FitConfig
from keyss.fitting.density import combine_densification
from keyss.fitting.image_metrics import mean_psnr
from keyss.fitting.loop import Interrupted, SilentReporter
from keyss.keys import random_embeddings
from keyss.methods import registry
from keyss.methods.base import SceneInput
from keyss.methods.learned.decoder import parse_mask
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import PRESETS, LearnedOptions
from keyss.methods.poses import CombinedPoses, PlacedScene
from keyss.rendering import render
from methods.learned.hiding import Hidden, hide_scenes, open_secret
from tiny_scenes import random_gaussians, tiny_scene

CONFIG = LearnedOptions(
    fit=FitConfig(iterations=80, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0),
)
SMALL: dict[str, Any] = {"hidden": (16, 16), "branch": 8}  # a decoder of few bytes
POINTS = replace(CONFIG, start="points", mask=parse_mask("op,ro,sc,xyz,sh"), decoder_rate=1e-2, **SMALL)
# What the paper has, small.
PAPER = replace(
    PRESETS["paper"],
    fit=replace(CONFIG.fit, iterations=60),
    design="standardised",
    decoder_rate=3e-3,
    **SMALL,
)
KEYS = ("first key", "second key")


def _moved(scene: Scene, frame: Similarity) -> Scene:
    """The same photos of a world that lies elsewhere."""
    return replace(
        scene,
        train=tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in scene.train),
        test=tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in scene.test),
        points=frame.apply_points(scene.points),
    )


def _scenes() -> tuple[list[Scene], list[Gaussians]]:
    """A cover and two secrets, one of them in a frame of its own, and their true models."""
    quaternion = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    )[0]
    rotation = quaternion * quaternion.det().sign()
    frame = Similarity(3.0, rotation, torch.tensor([5.0, -2.0, 1.0], dtype=torch.float64))
    scenes = [tiny_scene(0), _moved(tiny_scene(1), frame), tiny_scene(2, distance=5.0)]
    models = [
        random_gaussians(seed=0),
        frame.apply_gaussians(random_gaussians(seed=1)),
        random_gaussians(seed=2),
    ]
    return scenes, models


def _psnr(model: Gaussians, scene: Scene) -> float:
    return mean_psnr(model, scene.test, scene.background)


def _same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Gaussians))


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    scenes, models = _scenes()
    config = replace(POINTS, fit=replace(CONFIG.fit, iterations=200))
    return hide_scenes(scenes, KEYS, config, plains=models)


def test_the_published_model_shows_the_cover(hidden: Hidden) -> None:
    scenes, _ = _scenes()
    assert int((~is_appended(hidden.stego)).sum()) <= CONFIG.fit.max_gaussians
    for other in scenes[1:]:
        assert _psnr(hidden.stego, other) < _psnr(hidden.stego, scenes[0]) - 1


@pytest.mark.parametrize("secret", [1, 2])
def test_each_key_opens_its_secret_in_its_own_frame(hidden: Hidden, secret: int) -> None:
    scenes, _ = _scenes()
    revealed = hidden.secrets[secret - 1].reveal(hidden.stego)
    assert _psnr(revealed, scenes[secret]) > _psnr(hidden.stego, scenes[secret]) + 4


def test_frame_cover_leaves_the_secret_where_it_was_hidden(hidden: Hidden) -> None:
    scenes, _ = _scenes()
    own = hidden.secrets[0].reveal(hidden.stego)
    there = hidden.secrets[0].reveal(hidden.stego, frame="cover")
    frame = hidden.secrets[0].frame
    assert frame.scale != pytest.approx(1, abs=0.1)
    camera = scenes[1].test[0].camera
    difference = render(own, camera) - render(there, frame.apply_camera(camera))
    assert difference.abs().max() < 2e-3


def test_keys_open_their_own_and_wrong_ones_nothing(hidden: Hidden) -> None:
    for key, secret in zip(KEYS, hidden.secrets, strict=True):
        opened = open_secret(hidden.stego, key)
        assert torch.equal(opened.embedding, secret.embedding)
    for key in ("First key", "other"):
        with pytest.raises(WrongKeyError):
            open_secret(hidden.stego, key)


def test_an_embedding_of_no_key_shows_the_cover(hidden: Hidden) -> None:
    scenes, _ = _scenes()
    for embedding in random_embeddings(2, torch.Generator().manual_seed(5)):
        decoy = hidden.secrets[0].decode(hidden.stego, embedding)
        assert _psnr(decoy, scenes[0]) == pytest.approx(_psnr(hidden.stego, scenes[0]), abs=0.1)
        assert _psnr(decoy, scenes[2]) < _psnr(hidden.stego, scenes[2]) + 1


def test_appended_gaussians_are_not_decoded(hidden: Hidden) -> None:
    own = hidden.stego[~is_appended(hidden.stego)]
    assert len(own) < len(hidden.stego) - 1000
    for secret in hidden.secrets:
        assert _same(secret.reveal(hidden.stego), secret.reveal(own))
        assert secret.remains(secret.reveal(hidden.stego)).whole


def test_decoders_that_will_be_appended_are_told_of_before_any_work() -> None:
    inputs = [SceneInput(model, photos=True) for model in _scenes()[1]]
    with pytest.warns(KeyssWarning, match=r"600 Gaussians is too small.*in appended Gaussians"):
        registry.get("learned").prepare(inputs, POINTS)
    registry.get("learned").prepare(inputs[:2], POINTS.with_fit(max_gaussians=6000))


def test_a_model_large_enough_carries_its_secrets() -> None:
    scenes = _scenes()[0]
    fit = replace(CONFIG.fit, iterations=30, max_gaussians=3200, grow_every=10, grow_start=0.1)
    config = replace(CONFIG, fit=fit)
    many = [random_gaussians(3200, seed=7), *_scenes()[1][1:]]
    hidden = hide_scenes(scenes, KEYS, config, plains=many)
    assert len(hidden.stego) > 2500
    assert hidden.secrets == ()  # no decoder: the secrets themselves are in the low bits
    for key, scene in zip(KEYS, scenes[1:], strict=True):
        revealed = registry.open_model(hidden.stego, key).reveal(hidden.stego)
        assert _psnr(revealed, scene) > 26


def test_revealing_survives_order_and_pruning_and_refuses_another_model(hidden: Hidden) -> None:
    scenes, _ = _scenes()
    chosen = torch.randperm(len(hidden.stego), generator=torch.Generator().manual_seed(0))
    shuffled = hidden.secrets[1].reveal(hidden.stego[chosen])
    assert _psnr(shuffled, scenes[2]) == pytest.approx(
        _psnr(hidden.secrets[1].reveal(hidden.stego), scenes[2]), abs=0.1
    )
    hidden.secrets[1].reveal(hidden.stego[chosen[: len(chosen) // 2]])
    with pytest.raises(InputError, match="another one"):
        hidden.secrets[1].reveal(random_gaussians(seed=9))
    hidden.secrets[1].reveal(random_gaussians(seed=9), force=True)


class _InterruptAt(SilentReporter):
    """Presses Ctrl-C at one iteration of one stage."""

    def __init__(self, stage: str, iteration: int) -> None:
        self.stage, self.at = stage, iteration
        self.now = ""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.now = title

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if iteration == self.at and self.now.startswith(self.stage):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize(
    ("base", "stage"), [(CONFIG, "refit"), (POINTS, "hide"), (replace(PAPER, residuals="one-sided"), "hide")]
)
def test_interrupted_at_any_stage_it_resumes_to_the_same_result(
    tmp_path: Path, base: LearnedOptions, stage: str
) -> None:
    scenes = _scenes()[0][:2]
    config = replace(base, fit=replace(CONFIG.fit, iterations=40, grow_every=5))

    def run(resume: bool, reporter: SilentReporter | None = None) -> Hidden:
        return hide_scenes(scenes, KEYS[:1], config, checkpoints=tmp_path, resume=resume, reporter=reporter)

    whole = hide_scenes(scenes, KEYS[:1], config)
    with pytest.raises(Interrupted):
        run(False, _InterruptAt("plain model of the secret", 17))
    with pytest.raises(Interrupted):
        run(True, _InterruptAt(stage, 23))
    resumed = run(True)
    assert _same(resumed.stego, whole.stego)
    changed = replace(config, fit=replace(config.fit, sh0_rate=1e-3))
    with pytest.raises(InputError, match="other settings"):
        hide_scenes(scenes, KEYS[:1], changed, checkpoints=tmp_path, resume=True)


def test_targets_are_photos_where_there_are_and_renders_elsewhere() -> None:
    scenes, models = _scenes()
    frame = Similarity(0.5, torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    placed = [
        PlacedScene.of(scenes[0], models[0], Similarity.identity()),
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


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(UsageError, match='`start="points"`'):
        LearnedOptions(publish="any", start="points")
    decoding: list[dict[str, Any]] = [{"mask": ("xyz",)}, {"key_encoder": "clip"}, {"conditioning": "bias"}]
    for each in decoding:
        with pytest.raises(UsageError, match='`start="points"` gives them one'):
            LearnedOptions(**each)
        LearnedOptions(**each, start="points")


@pytest.mark.parametrize("preset", ["paper", "released"])
def test_the_published_presets_train(preset: str) -> None:
    """Few steps from sparse points: everything they switch on runs, and what comes out is finite."""
    scenes, models = _scenes()
    base = PRESETS[preset]
    config = replace(
        base, fit=replace(CONFIG.fit, iterations=12, grow_every=4, ssim_weight=base.fit.ssim_weight), **SMALL
    )
    hidden = hide_scenes(scenes, KEYS, config, plains=models)
    for secret in hidden.secrets:
        revealed = secret.reveal(hidden.stego)
        assert 0 < len(revealed) <= len(hidden.stego)
        assert all(getattr(revealed, f.name).isfinite().all() for f in fields(Gaussians))


@pytest.mark.parametrize("which", ["cover", "secret"])
def test_points_poses_and_densification_can_be_of_some_scenes_only(which: Any) -> None:
    scenes, models = _scenes()
    fit = replace(CONFIG.fit, iterations=12, grow_every=4)
    config = replace(PAPER, fit=fit, points=which, poses=which, densification=which)
    placed = [
        PlacedScene.of(scene, model, Similarity.identity())
        for scene, model in zip(scenes, models, strict=True)
    ]
    run = JointRun(placed, list(random_embeddings(2, torch.Generator())), config, torch.device("cpu"))
    owners = {pose[0] for _ in range(30) for pose in run._draw_poses()}
    assert owners == ({0} if which == "cover" else {1, 2})
    run.step()
