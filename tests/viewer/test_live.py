"""`--live`: a page that shows training progress."""

from __future__ import annotations

import http.client
import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import torch

from cli.harness import PROGRAM as KEYSS, SMALL
from files.scene_files import write_nerfstudio
from keyss.core import Gaussians
from keyss.files import model_of_bytes
from keyss.progress import Reporter
from keyss.viewer import LiveTraining
from keyss.viewer.live import EVERY
from test_progress import Timer
from tiny_scenes import random_gaussians
from viewer.browser import PROGRAM, Visit


@pytest.fixture
def clock() -> Timer:
    return Timer()


@pytest.fixture
def training(clock: Timer) -> Iterator[LiveTraining]:
    with LiveTraining(timer=clock) as found:
        yield found


def get(training: LiveTraining, name: str, folder: str | None = None) -> tuple[int, bytes]:
    where = urlsplit(training.address)
    connection = http.client.HTTPConnection("127.0.0.1", where.port or 0, timeout=30)
    connection.request("GET", (where.path if folder is None else folder) + name)
    try:
        answer = connection.getresponse()
    except http.client.RemoteDisconnected:
        return 0, b""
    return answer.status, answer.read()


def state(training: LiveTraining) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(get(training, "live")[1])
    return found


class Copies:
    """Counts copies of a model in training."""

    def __init__(self) -> None:
        self.model = random_gaussians(5)
        self.taken = 0

    def __call__(self) -> Gaussians:
        self.taken += 1
        return self.model


def step_once(reporter: Reporter, iteration: int, model: Callable[[], Gaussians]) -> None:
    reporter.update(iteration, 5, {"PSNR": 20.0})
    reporter.look(model)


def test_copies_only_while_watched(training: LiveTraining, clock: Timer) -> None:
    model, reporter = Copies(), training.reporter(Reporter())
    reporter.start("fit garden", 100, 0)
    for step in range(1, 10):
        clock.now += 1
        step_once(reporter, step, model)
    assert model.taken == 0
    assert state(training)["versions"] == {"published": 0, "secret": 0}
    step_once(reporter, 10, model)
    step_once(reporter, 11, model)
    assert model.taken == 1
    clock.now += EVERY
    step_once(reporter, 12, model)
    assert model.taken == 2
    assert state(training) == {
        "title": "fit garden",
        "iteration": 12,
        "iterations": 100,
        "gaussians": 5,
        "numbers": {"PSNR": 20.0},
        "versions": {"published": 2, "secret": 0},
    }
    clock.now += 60
    step_once(reporter, 13, model)
    assert model.taken == 2  # the viewer has left
    step_once(reporter, 100, model)
    assert model.taken == 3  # the last step is always copied


def test_copies_are_independent(training: LiveTraining) -> None:
    model, reporter = Copies(), training.reporter(Reporter())
    reporter.start("fit", 1, 0)
    step_once(reporter, 1, model)
    expected = model.model.digest()
    with torch.no_grad():
        model.model.means.add_(1.0)  # as an optimiser does
    status, ply = get(training, "live/published.ply")
    assert status == 200
    assert model_of_bytes("a.ply", ply).digest() == expected != model.model.digest()


def test_secret_is_served_separately(training: LiveTraining) -> None:
    reporter = training.reporter(Reporter())
    hidden = reporter.of_secret()
    model = Copies()
    hidden.start("plain model of the secret", 1, 0)
    step_once(hidden, 1, model)
    assert state(training)["versions"] == {"published": 0, "secret": 1}
    assert get(training, "live/published.ply")[0] != 200
    assert get(training, "live/secret.ply")[0] == 200


def test_address_is_required(training: LiveTraining) -> None:
    assert re.search(r"/[\w-]{20,}/$", training.address)
    assert get(training, "")[0] == 200
    for folder in ("/", "/live/", "/AAAAAAAAAAAAAAAAAAAAAA/"):
        for name in ("", "live", "secret.ply", "live/secret.ply", "viewer.js"):
            assert get(training, name, folder)[0] == 404, folder + name


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on PATH")
def test_live_fit(tab: Visit, tmp_path: Path) -> None:
    scene = write_nerfstudio(tmp_path / "scene", count=4)
    command = [*KEYSS, "fit", scene, "-o", tmp_path / "out", *SMALL[4:], "--live", "--iterations", 100_000]
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.match(r"(http://127\.0\.0\.1:[0-9]+/[\w-]+/) shows the training", line)
        assert found, line
        tab.goto(found[1])
        status = "document.getElementById('status').textContent"
        tab.page.wait_for_function(f"() => /^fit scene: step [0-9,]+ of 100,000, /.test({status})")
        assert tab.page.locator("#form").is_hidden()
        first = tab.page.evaluate(status)
        tab.page.wait_for_function(f"before => {status} !== before", arg=first)
        models = [url for url in tab.requests if url.endswith(".ply")]
        assert set(models) == {f"{found[1]}live/published.ply"}
        assert all(url.startswith((found[1], f"blob:{found[1][:20]}")) for url in tab.requests), tab.requests
        process.terminate()
        assert process.wait(60) == 143  # as without a page
        tab.page.wait_for_function(f"() => {status}.endsWith('The training has ended.')")
        # The page still polls for a while.
        tab.console_errors[:] = [each for each in tab.console_errors if "ERR_CONNECTION_REFUSED" not in each]
