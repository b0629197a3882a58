"""Times from a few steps: what they are made of, with a clock that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch

from keyss import FitConfig, Secret, api
from keyss.core import Gaussians, Scene
from keyss.core.scene import View
from keyss.keys import generate_key
from keyss.methods import registry
from keyss.methods.learned.options import PRESETS
from keyss.methods.peers.networks import Convolutions, untrained
from keyss.runs import probing
from keyss.runs.probing import Probe
from tiny_scenes import HEIGHT, WIDTH, random_gaussians, tiny_scene


@pytest.fixture
def even(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is timed is done once, and takes a second."""

    def timed(work: Callable[[View], object], views: Sequence[View]) -> float:
        work(views[0])
        return 1.0

    monkeypatch.setattr(probing, "_timed", timed)


@pytest.mark.usefixtures("even")
@pytest.mark.parametrize("channels", [3, 16])
@pytest.mark.parametrize(("rows", "times"), [(HEIGHT, 1), (HEIGHT // 2, 2)])
def test_a_network_comes_on_top_as_large_as_the_pictures_are(
    channels: int, rows: int, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probing, "NETWORK_PIXELS", rows * WIDTH)
    model = random_gaussians(150)
    plain = Probe(tiny_scene(0), model, FitConfig(max_gaussians=150), 3, torch.device("cpu"), True)
    assert (plain.picture(150), plain.step(150)) == (1, 1)
    shown = plain.through(untrained(channels))
    assert (shown.picture(150), shown.step(150)) == (1 + times, 1 + times)


@pytest.mark.usefixtures("even")
def test_only_methods_with_networks_are_told_longer() -> None:
    seconds = {}
    for name in ("3dgs-sh", "3dgs-decoder", "gs-hider"):
        options = registry.METHODS[name].presets["quick"].with_fit(iterations=10, max_gaussians=200, seed=0)
        plan = api.plan(tiny_scene(0), [Secret(tiny_scene(1), "")], method=options)
        by_name = {stage.name: stage.seconds for stage in plan.stages}
        seconds[name] = by_name["hiding"]
        assert by_name["plain model of the cover"] == 10
    # A drawing of each scene, and the network of one or of both.
    assert seconds == {"3dgs-sh": 20, "3dgs-decoder": 30, "gs-hider": 40}


@pytest.mark.usefixtures("even")
def test_the_joint_training_is_told_what_its_decoder_takes() -> None:
    seconds = {}
    for name in ("quick", "paper"):
        options = PRESETS[name].with_fit(iterations=10, max_gaussians=10_000, seed=0)
        plan = api.plan(tiny_scene(0), [Secret(tiny_scene(1), generate_key())], method=options)
        seconds[name] = next(stage.seconds for stage in plan.stages if stage.name == "hiding")
    # Only a secret is drawn; or cover and secret, through the decoder with the key, and with wrong ones.
    assert seconds == {"quick": 10, "paper": 30 + 10 / PRESETS["paper"].incorrect_every}


@pytest.mark.parametrize("channels", [3, 16])
def test_the_networks_of_plans_are_as_large_as_those_that_are_trained(channels: int) -> None:
    trained = Convolutions(channels).network(torch.zeros(channels))
    assert [each.shape for each in untrained(channels).tensors()] == [
        each.shape for each in trained.tensors()
    ]


def test_a_cap_that_is_none_is_not_filled_to_be_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probing, "MOST_PROBED", 300)
    made: list[int] = []
    make = probing._made_up

    def counted(scene: Scene, count: int, config: FitConfig) -> Gaussians:
        made.append(count)
        return make(scene, count, config)

    monkeypatch.setattr(probing, "_made_up", counted)
    config = FitConfig(max_gaussians=10_000_000)
    probe = probing.Probe(tiny_scene(), None, config, 3, torch.device("cpu"), True)
    assert sorted(made) == [200, 300]  # as many as there are sparse points, and no more than may be
    assert [count for count, *_ in probe.times] == [200, 300]
