"""Models take the place of photos: room for all of their Gaussians, and both come out as they went in."""

from __future__ import annotations

from keyss.fitting.image_metrics import mean_psnr
from keyss.methods.learned.config import HideConfig
from keyss.methods.learned.pipeline import hide_scenes
from keyss.methods.learned.revealing import open_secret, reveal_gaussians
from keyss.methods.learned.sizing import room_for_models
from keyss.rendering.orbit import scene_of_model
from tiny_scenes import random_gaussians

SIZE = 48


def test_one_model_hides_in_another_without_photos() -> None:
    models = [random_gaussians(1200, seed=0), random_gaussians(700, seed=1)]
    scenes = [scene_of_model(model, "m", size=SIZE) for model in models]
    config = room_for_models(HideConfig(), models)
    assert config.fit.max_gaussians == 1900
    hidden = hide_scenes(scenes, ["key"], config.with_fit(iterations=30, evaluate_every=0), plains=models)
    revealed = reveal_gaussians(hidden.stego, open_secret(hidden.stego, "key"))
    assert mean_psnr(hidden.stego, scenes[0].test, scenes[0].background) > 40
    assert mean_psnr(revealed, scenes[1].test, scenes[1].background) > 40
