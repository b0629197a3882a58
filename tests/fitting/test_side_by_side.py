"""Several fits at the same time, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch

from keyss import FitConfig, Secret, hide
from keyss.core import BackendError, Gaussians, InputError, Interrupted, same_bits
from keyss.fitting import Fit, fit_scenes, side_by_side, steps_done
from keyss.progress import Reporter
from methods.keyss.small import small
from other_processes import until
from tiny_scenes import tiny_scene

CONFIG = FitConfig(
    iterations=150, max_gaussians=260, grow_start=0.1, grow_every=20, evaluate_every=50, seed=0
)
STEPS = side_by_side.MIN_STEPS
ENDLESS = replace(CONFIG, iterations=10**6, evaluate_every=0)


class Recorder(Reporter):
    """Records all calls; calls `act` once, when all trainings have begun and one has reached step `at`."""

    several = True

    def __init__(self, at: int = -1, act: Callable[[], object] = lambda: None, loss_every: int = 0) -> None:
        self.at, self.act, self.loss_every = at, act, loss_every
        self.all = [self]
        self.said: list[tuple[object, ...]] = []

    def beside(self) -> Recorder:
        other = Recorder(self.at, self.act, self.loss_every)
        other.all = self.all
        self.all.append(other)
        return other

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.said.append(("start", title, iterations, iteration))

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.said.append(("update", iteration, gaussians, numbers))
        if 0 < self.at <= iteration and all(len(each.said) > 1 for each in self.all):
            for each in self.all:
                each.at = -1
            self.act()

    def finish(self) -> None:
        self.said.append(("finish",))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use processes for short fits too, as if there were two threads and much memory."""
    monkeypatch.setattr(side_by_side, "MIN_STEPS", 1)
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(side_by_side.psutil, "virtual_memory", lambda: SimpleNamespace(available=10**12))


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


@pytest.mark.counted
def test_models_are_the_same_to_the_bit_and_all_report() -> None:
    """The third fit runs alone."""
    reporter = Recorder(loss_every=60)
    fits = fits_of(None, CONFIG, reporter, count=3)
    models = fit_scenes(fits)
    for model, other in zip(models, one_by_one(fits), strict=True):
        assert same_bits(model, other)
    first, second = reporter.all
    alone = first.said[first.said.index(("finish",)) + 1 :]
    for fit, said in zip(fits, (first.said[: -len(alone)], second.said, alone), strict=True):
        assert said[0] == ("start", fit.title, CONFIG.iterations, 0)
        assert said[-1] == ("finish",)
        updates = [each for each in said if each[0] == "update"]
        assert [each[1] for each in updates] == list(range(1, CONFIG.iterations + 1))
        assert [each[1] for each in updates if "loss" in dict(each[3])] == [60, 120]  # type: ignore[call-overload]
        assert set(dict(updates[-1][3])) == {"PSNR"}  # type: ignore[call-overload]


@pytest.mark.counted
def test_an_interrupted_pair_resumes_to_the_same_models(tmp_path: Path) -> None:
    """Ctrl-C in a terminal reaches all processes, the first of which decides."""

    def press() -> None:
        for process in (*psutil.Process().children(), psutil.Process()):
            process.send_signal(signal.SIGINT)

    config = replace(CONFIG, iterations=450)
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, config, Recorder(50, press)))
    assert caught.value.args == (signal.SIGINT,)
    assert caught.value.checkpoint == tmp_path / "0.safetensors"
    assert multiprocessing.active_children() == []
    reporter = Recorder()
    fits = fits_of(tmp_path, config, reporter)
    before = [steps_done(fit.checkpoint) for fit in fits]
    assert min(before) > 0
    assert min(before) < 450
    resumed = fit_scenes(fits, resume=True)
    assert [each.said[0][3] for each in reporter.all] == before
    for model, other in zip(resumed, one_by_one(fits), strict=True):
        assert same_bits(model, other)


def test_an_error_of_one_fit_is_raised_and_interrupts_the_others(tmp_path: Path) -> None:
    fit_scenes(fits_of(tmp_path, replace(CONFIG, iterations=5), count=1))
    (tmp_path / "0.safetensors").rename(tmp_path / "1.safetensors")
    with pytest.raises(InputError, match=r"1\.safetensors: belongs to a run with other settings") as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS), resume=True)
    assert "fit_scene" in caught.value.__notes__[0]  # the traceback
    assert multiprocessing.active_children() == []


def test_a_killed_process_is_reported_and_the_others_save(tmp_path: Path) -> None:
    def kill() -> None:
        multiprocessing.active_children()[0].kill()

    with pytest.raises(BackendError) as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS, Recorder(50, kill)))
    said = str(caught.value)
    assert "has ended (exit code -9), as systems end processes when memory runs out" in said
    saved = {path.name for path in tmp_path.iterdir()}
    assert saved == ({"1.safetensors"} if said.startswith("the process of the fit 0") else {"0.safetensors"})


def test_processes_end_with_the_one_that_started_them_and_do_not_run_its_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(
        "from fitting.test_side_by_side import ENDLESS, fits_of, side_by_side\n"
        "print('once', flush=True)\n"
        "side_by_side.MIN_STEPS = 1\n"
        "side_by_side.torch.get_num_threads = lambda: 2\n"
        "side_by_side.fit_scenes(fits_of(None, ENDLESS))"
    )
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    with (tmp_path / "said.txt").open("w") as said:
        script = psutil.Popen(
            [sys.executable, tmp_path / "script.py"], env={**os.environ, "PYTHONPATH": paths}, stdout=said
        )
    try:
        until(lambda: sum("spawn_main" in " ".join(each.cmdline()) for each in script.children()) == 2)
        children = script.children()
    finally:
        script.kill()
        script.wait()
    assert psutil.wait_procs(children, 60)[1] == []
    assert (tmp_path / "said.txt").read_text() == "once\n"


@pytest.mark.filterwarnings("ignore:.*appended Gaussians")
def test_hiding_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Plain models and bounds of both scenes."""
    options = small("published", replace(CONFIG, iterations=60))
    found = []
    for least in (1, 10**6):
        monkeypatch.setattr(side_by_side, "MIN_STEPS", least)
        secret = Secret(tiny_scene(1), "a key of many characters: 93hXmQ2")
        out = tmp_path / str(least)
        hide(tiny_scene(0), [secret], method=options, bound=True, out=out, min_psnr=0)
        found.append({path.name: path.read_bytes() for path in out.rglob("*.ply")})
    assert found[0] == found[1]
    assert {"model.ply", "cover.ply", "secret-1.ply"} <= set(found[0])


@pytest.mark.parametrize(
    ("steps", "threads", "gigabytes", "device", "expected"),
    [
        ([STEPS] * 2, 2, 100, "cpu", 2),
        ([STEPS] * 3, 2, 100, "cpu", 2),
        ([STEPS] * 3, 16, 100, "cpu", 3),
        ([STEPS] * 2, 1, 100, "cpu", 1),
        ([STEPS] * 3, 16, 1.1, "cpu", 2),
        ([STEPS] * 3, 16, 0.1, "cpu", 1),
        ([STEPS, STEPS - 1], 2, 100, "cpu", 1),
        ([STEPS], 2, 100, "cpu", 1),
        ([STEPS] * 2, 2, 100, "cuda", 1),
    ],
)
def test_how_many_at_once(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[int],
    threads: int,
    gigabytes: float,
    device: str,
    expected: int,
) -> None:
    fits = [Fit(tiny_scene(), replace(CONFIG, iterations=each), "fit") for each in steps]
    monkeypatch.setattr(side_by_side, "MIN_STEPS", STEPS)
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: threads)
    memory = SimpleNamespace(available=int(gigabytes * 2**30))
    monkeypatch.setattr(side_by_side.psutil, "virtual_memory", lambda: memory)
    assert side_by_side.at_once(fits, torch.device(device)) == expected
    shown = [replace(fit, reporter=Reporter()) for fit in fits]  # as `--live`, whose page displays one
    assert side_by_side.at_once(shown, torch.device(device)) == 1
