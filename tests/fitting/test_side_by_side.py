"""Several fits at the same time, each in a process of its own."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from keyss import FitConfig, LearnedOptions, Secret, hide
from keyss.core import Gaussians, InputError
from keyss.core.errors import OtherProcessError
from keyss.core.gaussians import same_bits
from keyss.fitting import Interrupted, side_by_side, worker
from keyss.fitting.checkpoint import load_checkpoint
from keyss.fitting.loop import SilentReporter
from keyss.fitting.side_by_side import LEAST_STEPS, Fit, at_once, fit_scenes, process_bytes
from other_processes import command_of, descendants, until
from tiny_scenes import tiny_scene

pytestmark = pytest.mark.counted

CONFIG = FitConfig(
    iterations=150, max_gaussians=260, grow_start=0.1, grow_every=20, evaluate_every=50, seed=0
)
ENDLESS = replace(CONFIG, iterations=10**6, evaluate_every=0)
CPU = torch.device("cpu")


class Recorder(SilentReporter):
    """Keeps what it is told, and does something at one step of any training, or as the first begins."""

    def __init__(self, at: int = -1, loss_every: int = 0) -> None:
        self.at, self.loss_every = at, loss_every
        self.all = [self]
        self.said: list[tuple[object, ...]] = []

    def beside(self) -> Recorder:
        other = Recorder(self.at or -1, self.loss_every)
        other.act, other.all = self.act, self.all  # type: ignore[method-assign]
        self.all.append(other)
        return other

    def act(self) -> None: ...

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.said.append(("start", title, iterations, iteration))
        if self.at == 0:
            self.at = -1
            self.act()

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.said.append(("update", iteration, gaussians, numbers))
        if 0 < self.at <= iteration:
            self.at = -1
            self.act()

    def finish(self) -> None:
        self.said.append(("finish",))


class Signalled(Recorder):
    """Sends this process a signal."""

    def __init__(self, at: int, signum: int = signal.SIGINT) -> None:
        super().__init__(at)
        self.signum = signum

    def act(self) -> None:
        os.kill(os.getpid(), self.signum)


@pytest.fixture
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also fits of a few steps are done at the same time, and two threads are there."""
    monkeypatch.setattr(side_by_side, "LEAST_STEPS", 1)
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(side_by_side._processes, "usable_cores", lambda: 2)


at_the_same_time = pytest.mark.usefixtures("_at_once")


def fits_of(
    folder: Path | None, config: FitConfig, reporter: Recorder | None = None, count: int = 2
) -> list[Fit]:
    return [
        Fit(
            tiny_scene(seed),
            replace(config, seed=seed),
            f"fit {seed}",
            folder / f"{seed}.safetensors" if folder else None,
            reporter,
        )
        for seed in range(count)
    ]


def one_by_one(fits: Sequence[Fit]) -> list[Gaussians]:
    return [model for fit in fits for model in fit_scenes([replace(fit, checkpoint=None, reporter=None)])]


@at_the_same_time
def test_models_are_the_same_to_the_bit_and_all_report(tmp_path: Path) -> None:
    reporter = Recorder(loss_every=60)
    fits = fits_of(tmp_path, CONFIG, reporter, count=3)
    models = fit_scenes(fits)
    for model, other in zip(models, one_by_one(fits), strict=True):
        assert same_bits(model, other)
    assert len(reporter.all) == 3
    for fit, model, each in zip(fits, models, reporter.all, strict=True):
        assert each.said[0] == ("start", fit.title, CONFIG.iterations, 0)
        assert each.said[-1] == ("finish",)
        assert [what for what, *_ in each.said].count("finish") == 1
        kind, iteration, gaussians, numbers = each.said[-2]
        assert (kind, iteration) == ("update", CONFIG.iterations)
        assert isinstance(gaussians, int)
        assert gaussians >= len(model)  # before faint ones are removed
        assert isinstance(numbers, dict)
        assert set(numbers) == {"PSNR"}
        losses = [what[1] for what in each.said if what[0] == "update" and "loss" in dict(what[3])]  # type: ignore[call-overload]
        assert losses == [60, 120]


@at_the_same_time
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_all_save_and_go_on_to_the_same_models(tmp_path: Path, signum: signal.Signals) -> None:
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, replace(CONFIG, iterations=20_000), Signalled(100, signum)))
    assert caught.value.args == (signum,)
    assert caught.value.checkpoint == tmp_path / "0.safetensors"
    assert descendants(os.getpid()) == []
    steps = [load_checkpoint(tmp_path / f"{seed}.safetensors")[1]["iteration"] for seed in range(2)]
    assert all(0 < each < 20_000 for each in steps)


@at_the_same_time
def test_an_interrupted_pair_resumes_to_the_same_models(tmp_path: Path) -> None:
    config = replace(CONFIG, iterations=600)
    with pytest.raises(Interrupted):
        fit_scenes(fits_of(tmp_path, config, Signalled(150)))
    reporter = Recorder()
    fits = fits_of(tmp_path, config, reporter)
    resumed = fit_scenes(fits, resume=True)
    assert any(int(str(each.said[0][3])) >= 100 for each in reporter.all)  # it goes on, it does not begin
    for model, other in zip(resumed, one_by_one(fits), strict=True):
        assert same_bits(model, other)


@at_the_same_time
def test_what_is_interrupted_before_it_has_begun_ends_at_once() -> None:
    reporter = Signalled(0)
    started = time.monotonic()
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(None, ENDLESS, reporter))
    assert caught.value.checkpoint is None
    assert time.monotonic() - started < 30
    assert [what for what, *_ in reporter.all[0].said] == ["start", "finish"]
    assert descendants(os.getpid()) == []


@at_the_same_time
def test_a_second_signal_ends_it_at_once(tmp_path: Path) -> None:
    """When processes do not answer, for example."""

    class Twice(Recorder):
        def act(self) -> None:
            for child in descendants(os.getpid()):
                os.kill(child, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGINT)
            signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
            signal.setitimer(signal.ITIMER_REAL, 0.5)

    with pytest.raises(KeyboardInterrupt):
        fit_scenes(fits_of(tmp_path, ENDLESS, Twice(1)))
    assert descendants(os.getpid()) == []


@at_the_same_time
def test_an_error_of_one_comes_through_and_stops_the_others(tmp_path: Path) -> None:
    fit_scenes(fits_of(tmp_path, replace(CONFIG, iterations=5), count=1))
    (tmp_path / "0.safetensors").rename(tmp_path / "1.safetensors")
    with pytest.raises(InputError, match=r"1\.safetensors: belongs to a run with other settings"):
        fit_scenes(fits_of(tmp_path, ENDLESS), resume=True)
    assert descendants(os.getpid()) == []


@at_the_same_time
def test_a_process_that_is_killed_is_told_and_the_others_save(tmp_path: Path) -> None:
    class Kill(Recorder):
        def act(self) -> None:
            os.kill(min(descendants(os.getpid())), signal.SIGKILL)

    with pytest.raises(OtherProcessError, match=r"fit 0 ended \(killed by signal 9\); continue with"):
        fit_scenes(fits_of(tmp_path, ENDLESS, Kill(50)))
    assert [path.name for path in tmp_path.iterdir()] == ["1.safetensors"]


@at_the_same_time
def test_a_signal_that_only_a_process_gets_interrupts_all(tmp_path: Path) -> None:
    class Terminate(Recorder):
        def act(self) -> None:
            os.kill(min(descendants(os.getpid())), signal.SIGTERM)

    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS, Terminate(50)))
    assert caught.value.args == (signal.SIGTERM,)
    assert {path.name for path in tmp_path.iterdir()} == {"0.safetensors", "1.safetensors"}


def test_processes_end_with_whoever_started_them(tmp_path: Path) -> None:
    code = (
        "from fitting.test_side_by_side import ENDLESS, fits_of, side_by_side\n"
        "side_by_side.LEAST_STEPS = 1\n"
        "side_by_side.torch.set_num_threads(2)\n"
        "side_by_side._processes.usable_cores = lambda: 2\n"
        "side_by_side.fit_scenes(fits_of(None, ENDLESS))"
    )
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    driver = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths})
    try:
        until(lambda: len(descendants(driver.pid)) == 2)
        children = descendants(driver.pid)
        assert all(worker.MODULE in command_of(each) for each in children)
    finally:
        driver.kill()
        driver.wait()
    until(lambda: not any(map(command_of, children)), 60)


@at_the_same_time
def test_a_process_that_cannot_be_started_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_by_side.sys, "executable", "/nowhere/python")
    with pytest.raises(OtherProcessError, match=r"fit 0 \(No such file or directory\); with OMP_NUM"):
        fit_scenes(fits_of(None, CONFIG))


@at_the_same_time
def test_one_after_the_other_where_a_reporter_cannot_be_told_of_several(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As with `--live`, whose page shows one training."""
    monkeypatch.setattr(side_by_side, "_fit_in_processes", None)
    models = fit_scenes([replace(fit, reporter=SilentReporter()) for fit in fits_of(None, CONFIG)])
    assert len(models) == 2


@at_the_same_time
def test_hiding_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    options = LearnedOptions(fit=replace(CONFIG, iterations=60), iterations=20, publish="any")
    found, begun = [], []
    start = side_by_side._Child.start
    monkeypatch.setattr(
        side_by_side._Child, "start", staticmethod(lambda *args: begun.append(args) or start(*args))
    )
    for least in (1, 10**6):
        monkeypatch.setattr(side_by_side, "LEAST_STEPS", least)
        secret = Secret(tiny_scene(1), "a key of many characters: 93hXmQ2")
        out = tmp_path / str(least)
        hide(tiny_scene(0), [secret], method=options, bound=True, out=out, min_psnr=0)
        names = ("publish/stego.ply", "private/plain/cover.ply", "private/plain/secret.ply")
        found.append([(out / name).read_bytes() for name in names if (out / name).exists()])
        assert len(found[0]) >= 1
    assert found[0] == found[1]
    assert len(begun) == 2


@pytest.mark.parametrize(
    ("steps", "threads", "cores", "memory", "device", "expected"),
    [
        ([LEAST_STEPS] * 2, 2, 2, None, "cpu", 2),
        ([LEAST_STEPS] * 3, 2, 2, None, "cpu", 2),
        ([LEAST_STEPS] * 3, 16, 16, None, "cpu", 3),
        ([LEAST_STEPS] * 3, 16, 1, None, "cpu", 1),
        ([LEAST_STEPS] * 2, 1, 2, None, "cpu", 1),
        ([LEAST_STEPS] * 3, 16, 16, 2.5, "cpu", 2),
        ([LEAST_STEPS] * 3, 16, 16, 0.5, "cpu", 1),
        ([LEAST_STEPS, LEAST_STEPS - 1], 2, 2, None, "cpu", 1),
        ([LEAST_STEPS], 2, 2, None, "cpu", 1),
        ([], 2, 2, None, "cpu", 1),
        ([LEAST_STEPS] * 2, 2, 2, None, "cuda", 1),
    ],
)
def test_how_many_at_once(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[int],
    threads: int,
    cores: int,
    memory: float | None,
    device: str,
    expected: int,
) -> None:
    fits = [Fit(tiny_scene(), replace(CONFIG, iterations=each), "fit") for each in steps]
    there = None if memory is None or not fits else round(memory * process_bytes(fits[0]))
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(
        side_by_side,
        "_processes",
        SimpleNamespace(usable_cores=lambda: cores, available_memory=lambda: there),
    )
    assert at_once(fits, torch.device(device)) == expected


def test_messages_say_what_was_said() -> None:
    scene = tiny_scene()
    views = [replace(view, drawn=torch.rand(3, 4, 3)) for view in scene.train[:2]]
    scene = replace(scene, train=(*views, *scene.train[2:]))
    order = worker.Order(len(scene.train), len(scene.test), CONFIG, "fit ä", "/a/b", True, 10)
    file = io.BytesIO()
    worker.send_order(file, order, scene)
    worker.send(file, worker.Progress(3, 4, {"loss": float("nan"), "PSNR": 0.1}))
    said = file.getvalue()

    file.seek(0)
    found = worker.receive_order(file)
    assert found is not None
    assert found[0] == order
    assert found[1].digest() == scene.digest()
    assert found[1].extent == scene.extent
    for view, other in zip(scene.views, found[1].views, strict=True):
        assert (view.camera.width, view.camera.height) == (other.camera.width, other.camera.height)
        assert (view.drawn is None) == (other.drawn is None)
        assert view.drawn is None or (other.drawn is not None and torch.equal(view.drawn, other.drawn))
    told = worker.receive(file)
    assert told is not None
    assert isinstance(told[0], worker.Progress)
    assert told[0].numbers["PSNR"] == 0.1
    assert told[0].numbers["loss"] != told[0].numbers["loss"]
    assert worker.receive(file) is None

    for cut in (0, 5, 8, 100, len(said) // 3):
        assert worker.receive_order(io.BytesIO(said[:cut])) is None
