"""Models take the place of photos: the cover keeps its Gaussians, and both come out as they went in."""

from __future__ import annotations

from keyss.fitting.image_metrics import mean_psnr
from keyss.methods import registry
from keyss.methods.base import SceneInput
from keyss.methods.learned.options import LearnedOptions, sized
from keyss.rendering.orbit import scene_of_model
from methods.learned.hiding import hide_scenes
from tiny_scenes import random_gaussians

SIZE = 48


def test_one_model_hides_in_another_without_photos() -> None:
    models = [random_gaussians(1200, seed=0), random_gaussians(700, seed=1)]
    scenes = [scene_of_model(model, "m", size=SIZE) for model in models]
    config = sized(LearnedOptions(), [SceneInput(model, photos=False) for model in models])
    assert (config.fit.max_gaussians, config.fit.iterations, config.fit.sh_degree) == (1200, 400, 3)
    hidden = hide_scenes(scenes, ["key"], config.with_fit(iterations=30, evaluate_every=0), plains=models)
    assert len(hidden.stego) == 1200
    revealed = registry.open_model(hidden.stego, "key").reveal(hidden.stego)
    assert mean_psnr(hidden.stego, scenes[0].test, scenes[0].background) > 40
    assert mean_psnr(revealed, scenes[1].test, scenes[1].background) > 40


def test_what_is_asked_for_is_kept() -> None:
    models = [random_gaussians(120), random_gaussians(70)]
    inputs = [SceneInput(model, photos=False) for model in models]
    asked = LearnedOptions().with_fit(iterations=900, max_gaussians=500)
    found = sized(asked, inputs)
    assert (found.fit.iterations, found.fit.max_gaussians) == (900, 500)
    assert sized(LearnedOptions(), inputs).fit.max_gaussians == 120
    for like_any_other in (LearnedOptions().with_fit(max_gaussians=119), LearnedOptions(start="points")):
        assert sized(like_any_other, inputs) == like_any_other
    assert sized(asked, [inputs[0], SceneInput(models[1], photos=True)]) == asked
    assert sized(asked, [inputs[0], SceneInput(None, photos=True)]) == asked


def test_harmonics_are_those_of_the_cover_unless_asked_for() -> None:
    for cover in range(4):
        model, secret = random_gaussians(120, sh_degree=cover), random_gaussians(70, sh_degree=2)
        for photos in (True, False):
            inputs = [SceneInput(model, photos), SceneInput(secret, photos)]
            assert sized(LearnedOptions(), inputs).fit.sh_degree == cover
            assert sized(LearnedOptions(sh_degree=1), inputs).fit.sh_degree == 1
    fitted = [SceneInput(None, photos=True), SceneInput(secret, photos=True)]
    assert sized(LearnedOptions(), fitted).fit.sh_degree == 3
    assert sized(LearnedOptions(sh_degree=2), fitted).fit.sh_degree == 2
