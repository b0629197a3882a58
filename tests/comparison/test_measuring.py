"""Published models judged beside plain ones: a plain one is usual, careless ones are not."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from keyss.comparison.measuring import PlainCovers, survival, trials
from keyss.core import Gaussians, InputError
from keyss.measure.robustness.survival import Reopened
from measure.stealth.careless import normalised, overwritten, plain
from tiny_scenes import random_gaussians, tiny_scene


class Covers(PlainCovers):
    """Without pictures, which such models have none of."""

    @cached_property
    def _plain_pictures(self) -> list[Any]:
        return [torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8).numpy()]

    def _pictures(self, model: Gaussians) -> list[Any]:
        return self._plain_pictures


@pytest.fixture(scope="module")
def covers() -> Covers:
    return Covers(tiny_scene(0), [normalised(plain(seed)) for seed in (9, 1, 2)])


def test_the_plain_model_is_as_usual_as_itself(covers: Covers) -> None:
    found = covers.judged(covers.models[0], True)
    assert found.classifier == found.classifier_plain
    assert found.stealth == found.stealth_plain
    assert found.stealth is not None
    assert found.stealth > 1e-3
    assert found.stegexpose == found.stegexpose_plain == 0.5


def test_what_is_careless_is_seen(covers: Covers) -> None:
    found = covers.judged(overwritten(covers.models[0]), True)
    assert found.stealth is not None
    assert found.stealth < 1e-6
    assert "unit" in (found.stealth_statistic or "")
    faint = covers.judged(replace(covers.models[0], opacity_logits=covers.models[0].opacity_logits - 9), True)
    assert faint.classifier is not None
    assert faint.classifier_plain is not None
    assert faint.classifier > 0.95
    assert faint.classifier_plain < 0.7


def test_of_what_is_no_3dgs_model_only_pictures_are_judged(covers: Covers) -> None:
    found = covers.judged(covers.models[0], False)
    assert (found.classifier, found.stealth, found.stealth_statistic) == (None, None, None)
    assert found.stegexpose == 0.5


def test_so_few_gaussians_tell_nothing() -> None:
    few = [random_gaussians(40, seed) for seed in range(3)]
    assert Covers(tiny_scene(0), few).judged(few[0], True).classifier is None


@pytest.fixture
def scenes() -> list[Any]:
    return [tiny_scene(0), tiny_scene(1)]


def run_that(opens: Any) -> Any:
    return SimpleNamespace(reopeners=[lambda stego: Reopened(opens(stego))])


def test_a_secret_that_does_not_open_is_lost(scenes: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("keyss.measure.robustness.conversions.find_splat_transform", lambda: "/no/such/tool")
    stego, secret = random_gaussians(150, 0), random_gaussians(150, 1)

    def unchanged_only(model: Gaussians) -> Gaussians:
        if not torch.equal(model.means, stego.means[: len(model)]) or len(model) < len(stego):
            raise InputError("changed")
        return secret

    found = {row.change: row for row in survival(run_that(unchanged_only), stego, scenes, True)}
    assert list(found) == list(trials(scenes[0]))
    assert found["pruned"].secret_loss is None
    assert found["pruned"].cover_loss is not None
    assert found["purified"].secret_loss is None
    assert found["compressed .ply"].skipped is not None  # the tool failed: nothing is known
    assert found["compressed .ply"].cover_loss is None
    assert found[".spz"].skipped is None
    kept = {row.change: row for row in survival(run_that(lambda _: secret), stego, scenes, True)}
    assert kept["pruned"].secret_loss == 0


def test_programs_for_3dgs_models_are_not_tried_on_others(scenes: list[Any]) -> None:
    stego = random_gaussians(150, 0)
    rows = survival(run_that(lambda _: stego), stego, scenes, False)
    assert [row.change for row in rows if row.skipped is None] == ["pruned"]
