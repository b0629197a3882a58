"""Losses of cover and secrets after changes of published models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import pytest
import torch

import keyss
from keyss import CarryOptions
from keyss.core import BackendError, Gaussians, KeyssWarning, Scene, Similarity, UsageError, WrongKeyError
from keyss.fitting import mean_psnr
from keyss.lab import (
    ChangedQuality,
    converters,
    half_floats,
    measure_robustness,
    purification,
    random_pruning,
)
from keyss.methods import HiddenScene, open_model
from methods.carry.test_fine_tuning import TINY
from methods.hiding import hide_scenes, moved, three_scenes
from tiny_scenes import random_gaussians, tiny_scene

KEY = "the right key"


@dataclass(frozen=True)
class Whole:
    """A `HiddenScene` with a known model."""

    gaussians: Gaussians
    frame: Similarity | None = None

    def reveal(self, stego: Gaussians, **_: Any) -> Gaussians:
        return self.gaussians


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tiny_scene(0, views=8)


def test_loss_is_the_difference_of_psnr(scene: Scene) -> None:
    """The secret is the cover, so every number is known; two seeds of one change give their mean."""
    model = random_gaussians(seed=0)
    changes = [random_pruning(0.5, seed) for seed in (0, 1)]
    shares: list[float] = []
    rows = measure_robustness(model, [Whole], [scene, scene], changes=changes, share=shares.append)
    assert [(row.attack, row.seeds) for row in rows] == [("none", 1), ("random pruning", 2)]
    before = mean_psnr(model, scene.test, scene.background)
    assert rows[0].cover == rows[0].secrets[0] == ChangedQuality(before, 0)
    after = fmean(mean_psnr(change(model), scene.test, scene.background) for change in changes)
    assert rows[1].cover is not None
    assert (rows[1].cover.psnr, rows[1].cover.loss) == pytest.approx((after, before - after))
    assert rows[1].secrets == (rows[1].cover,)
    assert shares == [0, 1 / 3, 2 / 3]
    assert measure_robustness(model, [Whole], [scene, scene], changes=changes) == rows


def test_lost_secret_is_at_chance_level(scene: Scene) -> None:
    """The secret's cameras are the cover's in another frame: chance level is the cover's quality."""
    model = random_gaussians(seed=0)
    frame = Similarity(2.0, translation=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    elsewhere = moved(scene, frame.inverse())

    def opener(changed: Gaussians) -> Whole:
        if len(changed) < len(model):
            raise WrongKeyError("this key opens nothing here")
        return Whole(frame.inverse().apply_gaussians(changed), frame)

    changes = [random_pruning(0.2), half_floats()]
    rows = measure_robustness(model, [opener], [scene, elsewhere], changes=changes)
    (lost,), (opened,) = rows[1].secrets, rows[2].secrets
    assert (lost.opens, lost.error) == (False, "this key opens nothing here")
    assert rows[1].cover is not None
    assert lost.psnr == pytest.approx(rows[1].cover.psnr, abs=0.01)
    assert opened.opens
    with pytest.raises(UsageError, match="each of 1 secret"):
        measure_robustness(model, [], [scene, scene], changes=[])
    with pytest.raises(WrongKeyError):
        measure_robustness(model[:5], [opener], [scene, elsewhere], changes=[])


def test_missing_converter_is_skipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Scene) -> None:
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(tmp_path / "nowhere"))
    (sog,) = (converter for converter in converters() if converter.format == ".sog")
    model, change = random_gaussians(seed=0), sog.change()
    with pytest.raises(BackendError, match="npm install"):
        change(model)
    rows = measure_robustness(model, [Whole], [scene, scene], changes=[change, half_floats()])
    assert "splat-transform is not installed" in (rows[1].skipped or "")
    assert rows[1].cover is None
    assert rows[2].skipped is None


# --- hidden secrets --------------------------------------------------------------------------------------


def opener(stego: Gaussians) -> HiddenScene:
    return open_model(stego, KEY)


@pytest.fixture(scope="module")
def pair() -> tuple[list[Scene], list[Gaussians]]:
    scenes, _ = three_scenes()
    return [scenes[0], scenes[2]], [random_gaussians(1500, seed=0), random_gaussians(200, seed=2)]


@pytest.mark.parametrize("publish", ["unchanged", "converted"])
def test_fine_tuned_secret_after_changes(
    publish: Literal["unchanged", "converted"], pair: tuple[list[Scene], list[Gaussians]]
) -> None:
    scenes, models = pair
    config = CarryOptions(
        fit=replace(TINY, iterations=5, max_gaussians=2000, boost=1.0), publish=publish, fine_tune="always"
    )
    hidden = hide_scenes(scenes, [KEY], config, plains=models)
    revealed = keyss.reveal(hidden.stego, KEY).gaussians
    assert opener(hidden.stego).reveal(hidden.stego).digest() == revealed.digest()

    changes = [random_pruning(0.1), half_floats(), purification(scenes[0], steps=0)]
    _, pruned, rounded, purified = measure_robustness(hidden.stego, [opener], scenes, changes=changes)
    if publish == "unchanged":
        with pytest.warns(KeyssWarning, match="shards of the secret's payload were lost, and restored"):
            keyss.reveal(changes[0](hidden.stego), KEY)
    assert pruned.secrets[0].opens
    assert pruned.secrets[0].psnr == mean_psnr(revealed, scenes[1].test, scenes[1].background)
    assert rounded.secrets[0].opens == (publish == "converted")
    if publish == "converted":
        assert rounded.secrets[0].loss == 0
    else:
        assert rounded.secrets[0].error == "this key opens nothing here"
        assert rounded.secrets[0].loss > 10
    assert purified.cover is not None
    assert abs(purified.cover.loss) < 0.1
    if publish == "converted":
        assert purified.secrets[0].loss > 10  # appended Gaussians are not seen in the cover
