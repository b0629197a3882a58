"""Published models judged beside plain ones: a plain one is usual, careless ones are not."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from keyss.core import Gaussians, InputError
from keyss.lab.audits import comparison_measures as measures
from lab.stealth.careless import normalised, overwritten, plain
from tiny_scenes import random_gaussians, tiny_scene


class Covers(measures.PlainCovers):
    """Without pictures, which such models have none of."""

    @cached_property
    def plain_pictures(self) -> list[Any]:
        return [torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8).numpy()]

    def pictures(self, model: Gaussians) -> list[Any]:
        return self.plain_pictures


@pytest.fixture(scope="module")
def covers() -> Covers:
    return Covers(tiny_scene(0), [normalised(plain(seed, 1000)) for seed in (9, 1, 2)])


def test_the_plain_model_is_as_usual_as_itself(covers: Covers) -> None:
    found = covers.judge(covers.models[0], True)
    assert found == covers.own
    assert found["stealth"] > 1e-3
    assert found["stegexpose"] == 0.5


def test_what_is_careless_is_seen(covers: Covers) -> None:
    assert covers.judge(overwritten(covers.models[0]), True)["stealth"] < 1e-6
    faint = covers.judge(replace(covers.models[0], opacity_logits=covers.models[0].opacity_logits - 9), True)
    assert faint["classifier"] > 0.95
    assert covers.own["classifier"] < 0.7


def test_of_what_is_no_3dgs_model_only_pictures_are_judged(covers: Covers) -> None:
    assert covers.judge(covers.models[0], False) == {"stegexpose": 0.5}


def test_so_few_gaussians_tell_nothing() -> None:
    few = [random_gaussians(40, seed) for seed in range(3)]
    assert "classifier" not in Covers(tiny_scene(0), few).judge(few[0], True)


@pytest.fixture
def scenes() -> list[Any]:
    return [tiny_scene(0), tiny_scene(1)]


def losses(stego: Gaussians, scenes: list[Any], opens: Any, standard: bool = True) -> dict[str, Any]:
    """The result of `survival` for a run whose secret opens so."""
    run = SimpleNamespace(
        stego=stego,
        openers=[lambda stego: SimpleNamespace(frame=None, reveal=lambda stego, force=False: opens(stego))],
        scenes=lambda train_pictures: scenes,
        config=SimpleNamespace(method="carry" if standard else "gs-hider"),
    )
    return measures.survival(measures.Subject(run, "cpu"))  # type: ignore[arg-type]


def test_a_secret_that_does_not_open_is_lost(scenes: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("keyss.lab.robustness.survival.find_splat_transform", lambda: "/no/such/tool")
    stego, secret = random_gaussians(150, 0), random_gaussians(150, 1)

    def unchanged_only(model: Gaussians) -> Gaussians:
        if not torch.equal(model.means, stego.means[: len(model)]) or len(model) < len(stego):
            raise InputError("changed")
        return secret

    found = losses(stego, scenes, unchanged_only)
    assert set(measures.trials(scenes[0])) == {
        name.removesuffix(".cover").removesuffix(".secret") for name in found
    }
    assert "pruned.cover" in found
    assert {"pruned.secret", "purified.secret"}.isdisjoint(found)
    assert isinstance(found["compressed .ply"], str)  # the tool failed: nothing is known
    assert "compressed .ply.cover" not in found
    assert ".spz.cover" in found
    assert losses(stego, scenes, lambda _: secret)["pruned.secret"] == 0


def test_programs_for_3dgs_models_are_not_tried_on_others(scenes: list[Any]) -> None:
    stego = random_gaussians(150, 0)
    found = losses(stego, scenes, lambda _: stego, standard=False)
    tried = {name for name, each in found.items() if not isinstance(each, str)}
    assert tried == {"pruned.cover", "pruned.secret"}
