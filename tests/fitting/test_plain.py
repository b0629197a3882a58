from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fitting.small_trainings import FIT, training
from keyss.core import InputError, Interrupted, UsageError
from keyss.fitting import (
    FitConfig,
    PlainRun,
    Target,
    TrainingRun,
    fit_scene,
    load_checkpoint,
    mean_psnr,
    photometric_loss,
    save_checkpoint,
    train,
)
from keyss.fitting.schedule import shrinking
from keyss.progress import Reporter
from keyss.rendering import render_with_meta
from tiny_scenes import tiny_scene

CONFIG = FitConfig(
    iterations=150, max_gaussians=260, grow_start=0.1, grow_every=20, evaluate_every=50, seed=0
)


class InterruptAt(Reporter):
    """Send SIGINT at one iteration of the training whose title begins with `stage`."""

    def __init__(self, iteration: int, stage: str = "") -> None:
        self.iteration, self.stage = iteration, stage
        self.title = ""

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.title = title

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if iteration == self.iteration and self.title.startswith(self.stage):
            os.kill(os.getpid(), signal.SIGINT)


def test_fit_improves_psnr() -> None:
    scene, config = tiny_scene(), replace(CONFIG, iterations=400)
    start = PlainRun(scene, config, torch.device("cpu")).gaussians()
    fitted = fit_scene(scene, config).gaussians
    before, after = (mean_psnr(model, scene.test, scene.background) for model in (start, fitted))
    assert after > before + 3
    assert len(start) < len(fitted) <= config.max_gaussians


def test_faint_gaussians_are_removed_at_the_end() -> None:
    """Of the model, and of the number that progress reports."""
    counts: list[int] = []

    class Counting(Reporter):
        def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
            counts.append(gaussians)

    config = replace(CONFIG, iterations=20, grow_stop=0.0, prune_opacity=0.1)  # points begin at 0.1
    fitted = fit_scene(tiny_scene(), config, reporter=Counting()).gaussians
    assert len(fitted) == counts[-1] < counts[-2]
    assert fitted.opacities.min() >= 0.1


def test_masked_pixels_are_ignored() -> None:
    scene, config = tiny_scene(views=32), replace(CONFIG, iterations=300)
    generator = torch.Generator().manual_seed(5)
    masked, occluded = [], []
    for index, view in enumerate(scene.train):
        mask, image = torch.ones(view.image.shape[:2], dtype=torch.bool), view.image.clone()
        if index % 3:  # an occluder
            x, y = (int(torch.randint(low, low + 8, (1,), generator=generator)) for low in (8, 5))
            mask[y : y + 12, x : x + 14] = False
            image[~mask] = torch.tensor([255, 0, 255], dtype=torch.uint8)
        masked.append(replace(view, mask=mask))
        occluded.append(replace(view, image=image, mask=mask))
    unmasked = [replace(view, mask=None) for view in occluded]
    with_masks, same, without = (
        fit_scene(replace(scene, train=tuple(views)), config).gaussians
        for views in (occluded, masked, unmasked)
    )
    assert with_masks.digest() == same.digest()
    good, bad = (mean_psnr(model, scene.test, scene.background) for model in (with_masks, without))
    assert good > bad + 2


def test_large_photos_are_shrunk() -> None:
    """The loss of the first step follows from the means of blocks of pixels."""
    scene, config = tiny_scene(), replace(CONFIG, iterations=20)
    generator = torch.Generator().manual_seed(3)
    view = scene.train[0]
    width, height = 600, 400
    factor = shrinking(config, 1, width * height)
    assert factor == 2
    image = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    mask = torch.rand(height // factor, width // factor, generator=generator) < 0.7
    whole = mask.repeat_interleave(factor, 0).repeat_interleave(factor, 1)
    large = replace(view, image=image, camera=view.camera.resized(width, height), mask=whole)
    run = PlainRun(replace(scene, train=(large,)), config, torch.device("cpu"))
    means = image.float().reshape(height // factor, factor, width // factor, factor, 3).mean((1, 3))
    target = Target.of(means.round() / 255, mask)
    small = view.camera.resized(width // factor, height // factor)
    shown, _ = render_with_meta(run.gaussians(), small, scene.background, sh_degree=0)
    expected = float(photometric_loss(shown, target, config.ssim_weight))
    run.step()
    assert float(run.loss) == pytest.approx(expected, rel=1e-3)  # halves are rounded up or down


def test_seed() -> None:
    scene = tiny_scene()
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = fit_scene(scene, CONFIG).gaussians
    assert torch.equal(state, torch.get_rng_state())
    torch.manual_seed(2)
    assert first.digest() == fit_scene(scene, CONFIG).gaussians.digest()
    assert first.digest() != fit_scene(scene, replace(CONFIG, seed=1)).gaussians.digest()


@pytest.mark.parametrize("iteration", [1, 33])
def test_resume(tmp_path: Path, iteration: int) -> None:
    scene, path = tiny_scene(), tmp_path / "checkpoint.safetensors"
    with pytest.raises(Interrupted) as caught:
        fit_scene(scene, CONFIG, checkpoint=path, reporter=InterruptAt(iteration))
    assert caught.value.iteration == iteration
    resumed = fit_scene(scene, CONFIG, checkpoint=path, resume=True).gaussians
    assert resumed.digest() == fit_scene(scene, CONFIG).gaussians.digest()


def test_checkpoint_of_other_settings(tmp_path: Path) -> None:
    scene, path = tiny_scene(), tmp_path / "checkpoint.safetensors"
    fit_scene(scene, replace(CONFIG, iterations=5), checkpoint=path)
    with pytest.raises(InputError, match="other settings"):
        fit_scene(scene, CONFIG, checkpoint=path, resume=True)
    with pytest.raises(InputError, match="other settings"):
        fit_scene(tiny_scene(3), replace(CONFIG, iterations=5), checkpoint=path, resume=True)


def test_damaged_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, {"a": torch.ones(3)}, {"iteration": 1})
    data = path.read_bytes()
    for size in range(0, len(data), 7):
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            load_checkpoint(path)


def test_scene_without_points() -> None:
    scene = replace(tiny_scene(), points=torch.zeros(0, 3), colors=torch.zeros(0, 3, dtype=torch.uint8))
    fitted = fit_scene(scene, CONFIG).gaussians
    assert mean_psnr(fitted, scene.test, scene.background) > 18


@pytest.mark.parametrize("changes", [{"iterations": 0}, {"max_gaussians": -5}, {"sh_degree": 4}])
def test_invalid_settings(changes: dict[str, int]) -> None:
    with pytest.raises(UsageError, match=next(iter(changes))):
        FitConfig(**changes)  # type: ignore[arg-type]


def test_device_alias(tmp_path: Path) -> None:
    """ "cpu:0" is the device "cpu"."""
    scene, path = tiny_scene(), tmp_path / "checkpoint.safetensors"
    with pytest.raises(Interrupted):
        fit_scene(scene, CONFIG, checkpoint=path, reporter=InterruptAt(25))
    there = torch.device("cpu", 0)
    resumed = fit_scene(scene, CONFIG, device=there, checkpoint=path, resume=True).gaussians
    assert torch.equal(resumed.means, fit_scene(scene, CONFIG).gaussians.means)


def train_run(name: str, fit: FitConfig, device: str = "cpu", **options: Any) -> TrainingRun:
    run: TrainingRun = training(name, fit, torch.device(device))
    train(run, name, fingerprint={}, **options)
    return run


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["plain", "published", "gs-hider"])
def test_resume_across_devices(tmp_path: Path, name: str, cuda: torch.device) -> None:
    """Results differ slightly: the order of sums on a GPU varies."""
    path, fit = tmp_path / "checkpoint.safetensors", replace(FIT, iterations=60)
    with pytest.raises(Interrupted):
        train_run(name, fit, checkpoint=path, reporter=InterruptAt(25))
    with pytest.raises(Interrupted):
        train_run(name, fit, str(cuda), checkpoint=path, resume=True, reporter=InterruptAt(45))
    found = train_run(name, fit, checkpoint=path, resume=True)
    stayed = train_run(name, fit)
    assert abs(len(found) - len(stayed)) <= 0.05 * len(stayed)
    for what, psnr in stayed.evaluate().items():
        assert found.evaluate()[what] > psnr - 0.5, what
