"""Several fits at the same time, each in a process of its own."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from keyss import FitConfig, Secret, hide
from keyss.core import Gaussians, InputError, Interrupted, KeyssWarning, OtherProcessError, same_bits
from keyss.fitting import Fit, fit_scenes, side_by_side, steps_done
from keyss.progress import Reporter
from methods.keyss.small import small
from other_processes import command_of, descendants, until
from tiny_scenes import tiny_scene

CONFIG = FitConfig(
    iterations=150, max_gaussians=260, grow_start=0.1, grow_every=20, evaluate_every=50, seed=0
)
STEPS = side_by_side.MIN_STEPS
ENDLESS = replace(CONFIG, iterations=10**6, evaluate_every=0)
CPU = torch.device("cpu")


class Recorder(Reporter):
    """Records all calls, and acts once, when all trainings have begun and one has reached step `at`."""

    several = True

    def __init__(self, at: int = -1, loss_every: int = 0, count: int = 2) -> None:
        self.at, self.loss_every, self.count = at, loss_every, count
        self.all = [self]
        self.said: list[tuple[object, ...]] = []
        self.act: Callable[[], None] | None = None

    def beside(self) -> Recorder:
        other = Recorder(self.at, self.loss_every, self.count)
        other.act, other.all = self._act_once, self.all
        self.all.append(other)
        return other

    def _act_once(self) -> None:
        act, self.act = self.act, None
        if act is not None:
            act()

    def start(self, title: str, iterations: int, iteration: int) -> None:
        self.said.append(("start", title, iterations, iteration))
        if self.at == 0:
            self._act_once()

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        self.said.append(("update", iteration, gaussians, numbers))
        begun = sum(any(what == "update" for what, *_ in each.said) for each in self.all)
        if 0 < self.at <= iteration and begun == self.count:
            self._act_once()

    def finish(self) -> None:
        self.said.append(("finish",))


def acting(at: int, act: Callable[[], object]) -> Recorder:
    found = Recorder(at)
    found.act = lambda: (act(), None)[1]
    return found


def signalled(at: int, signum: int = signal.SIGINT) -> Recorder:
    """Sends this process a signal."""
    return acting(at, lambda: os.kill(os.getpid(), signum))


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use processes for short fits too, as if there were two threads and much memory."""
    monkeypatch.setattr(side_by_side, "MIN_STEPS", 1)
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(side_by_side._processes, "usable_cores", lambda: 2)
    monkeypatch.setattr(side_by_side._processes, "available_memory", lambda: None)


def pids() -> list[int]:
    """Processes of running fits."""
    return [pid for pid in descendants(os.getpid()) if "keyss.fitting.worker" in command_of(pid)]


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
def test_models_are_the_same_to_the_bit_and_all_report(tmp_path: Path) -> None:
    reporter = Recorder(loss_every=60, count=3)
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


@pytest.mark.counted
def test_an_interrupted_pair_resumes_to_the_same_models(tmp_path: Path) -> None:
    config = replace(CONFIG, iterations=450)
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, config, signalled(50)))
    assert caught.value.args == (signal.SIGINT,)
    assert caught.value.checkpoint == tmp_path / "0.safetensors"
    assert pids() == []
    reporter = Recorder()
    fits = fits_of(tmp_path, config, reporter)
    before = [steps_done(fit.checkpoint) for fit in fits]
    resumed = fit_scenes(fits, resume=True)
    assert [each.said[0][3] for each in reporter.all] == before
    assert min(before) < 450
    assert max(before) >= 30
    for model, other in zip(resumed, one_by_one(fits), strict=True):
        assert same_bits(model, other)


def test_a_signal_while_processes_load_ends_it_at_once() -> None:
    reporter = signalled(0)
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(None, ENDLESS, reporter))
    assert caught.value.checkpoint is None
    assert [what for what, *_ in reporter.all[0].said] == ["start", "finish"]
    assert pids() == []


@pytest.mark.parametrize(("at", "order"), [(0, 1), (0, -1), (50, -1)])
def test_a_signal_to_all_processes_interrupts(tmp_path: Path, at: int, order: int) -> None:
    """In any order, as a system ends a service."""

    def to_all() -> None:
        for pid in [os.getpid(), *pids()][::order]:
            os.kill(pid, signal.SIGTERM)

    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS, acting(at, to_all)))
    assert caught.value.args == (signal.SIGTERM,)
    assert len(list(tmp_path.iterdir())) == (2 if at else 0)


def test_a_second_signal_ends_it_at_once(tmp_path: Path) -> None:
    """For example if processes do not respond."""

    def twice() -> None:
        for pid in pids():
            os.kill(pid, signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGINT)
        signal.setitimer(signal.ITIMER_REAL, 0.5)

    before = signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    try:
        with pytest.raises(KeyboardInterrupt):
            fit_scenes(fits_of(tmp_path, ENDLESS, acting(1, twice)))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert pids() == []


def test_an_ignored_ctrl_c_stays_ignored() -> None:
    """As in a background command of a script."""

    def to_all() -> None:
        for pid in [os.getpid(), *pids()]:
            os.kill(pid, signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        models = fit_scenes(fits_of(None, CONFIG, acting(1, to_all)))
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(models) == 2


def test_an_error_of_one_fit_is_raised_and_stops_the_others(tmp_path: Path) -> None:
    fit_scenes(fits_of(tmp_path, replace(CONFIG, iterations=5), count=1))
    (tmp_path / "0.safetensors").rename(tmp_path / "1.safetensors")
    with pytest.raises(InputError, match=r"1\.safetensors: belongs to a run with other settings"):
        fit_scenes(fits_of(tmp_path, ENDLESS), resume=True)
    assert pids() == []


@pytest.mark.counted
def test_unexpected_errors_are_equal_to_those_of_a_fit_in_this_process() -> None:
    good, bad = fits_of(None, ENDLESS)
    first = bad.scene.train[0]
    views = (replace(first, camera=replace(first.camera, K=torch.eye(2))), *bad.scene.train[1:])
    bad = replace(bad, scene=replace(bad.scene, train=views))
    with pytest.raises(ValueError, match="K") as alone:
        fit_scenes([bad])
    with pytest.raises(type(alone.value)) as caught:
        fit_scenes([good, bad])
    assert str(caught.value) == str(alone.value)
    assert "fit_scene" in caught.value.__notes__[0]  # the traceback
    assert pids() == []


def test_a_killed_process_is_reported_and_the_others_save(tmp_path: Path) -> None:
    killing = acting(50, lambda: os.kill(pids()[0], signal.SIGKILL))
    with pytest.raises(OtherProcessError) as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS, killing))
    said = str(caught.value)
    killed = re.match(
        r"the process for the fit (\d) has ended \(killed by signal 9\); nothing was saved", said
    )
    assert killed
    assert "OMP_NUM_THREADS=1" in said
    assert [path.name for path in tmp_path.iterdir()] == [f"{1 - int(killed[1])}.safetensors"]


def test_a_signal_to_one_process_interrupts_all(tmp_path: Path) -> None:
    with pytest.raises(Interrupted) as caught:
        fit_scenes(fits_of(tmp_path, ENDLESS, acting(50, lambda: os.kill(pids()[0], signal.SIGTERM))))
    assert caught.value.args == (signal.SIGTERM,)
    assert {path.name for path in tmp_path.iterdir()} == {"0.safetensors", "1.safetensors"}


def test_processes_end_with_their_parent_and_do_not_run_its_program(tmp_path: Path) -> None:
    (tmp_path / "driver.py").write_text(
        "from fitting.test_side_by_side import ENDLESS, fits_of, side_by_side\n"
        "print('once', flush=True)\n"
        "side_by_side.MIN_STEPS = 1\n"
        "side_by_side.torch.set_num_threads(2)\n"
        "side_by_side._processes.usable_cores = lambda: 2\n"
        "side_by_side._processes.available_memory = lambda: None\n"
        "side_by_side.fit_scenes(fits_of(None, ENDLESS))"
    )
    (tmp_path / "queue.py").write_text("raise SystemExit(9)")  # nothing is imported from where it runs
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    with (tmp_path / "said.txt").open("w") as said:
        driver = subprocess.Popen(
            [sys.executable, "-P", "driver.py"],
            env={**os.environ, "PYTHONPATH": paths},
            cwd=tmp_path,
            stdout=said,
        )
    try:
        until(
            lambda: sum("keyss.fitting.worker" in command_of(each) for each in descendants(driver.pid)) == 2
        )
        children = descendants(driver.pid)
        time.sleep(4)
        assert all(map(command_of, children))
    finally:
        driver.kill()
        driver.wait()
    until(lambda: not any(map(command_of, children)), 60)
    assert (tmp_path / "said.txt").read_text() == "once\n"


@pytest.mark.parametrize("program", ["/nowhere/python", "/bin/false"])
def test_fits_run_one_after_the_other_if_no_process_can_be_started(
    monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    monkeypatch.setattr(sys, "executable", program)
    monkeypatch.setattr(side_by_side._processes, "can_start", lambda: True)
    reporter = Recorder()
    with pytest.warns(KeyssWarning, match="one after the other"):
        models = fit_scenes(fits_of(None, CONFIG, reporter))
    assert len(models) == 2
    starts = [what for each in reporter.all for what, *_ in each.said if what in ("start", "finish")]
    assert starts.count("start") == starts.count("finish") >= 2


def test_fits_run_one_after_the_other_if_the_reporter_displays_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As with `--live`, whose page displays one training."""
    monkeypatch.setattr(side_by_side, "_fit_in_processes", None)
    models = fit_scenes([replace(fit, reporter=Reporter()) for fit in fits_of(None, CONFIG)])
    assert len(models) == 2


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
    ("steps", "threads", "cores", "memory", "device", "can_start", "expected"),
    [
        ([STEPS] * 2, 2, 2, None, "cpu", True, 2),
        ([STEPS] * 3, 2, 2, None, "cpu", True, 2),
        ([STEPS] * 3, 16, 16, None, "cpu", True, 3),
        ([STEPS] * 3, 16, 1, None, "cpu", True, 1),
        ([STEPS] * 2, 1, 2, None, "cpu", True, 1),
        ([STEPS] * 3, 16, 16, 2.5, "cpu", True, 2),
        ([STEPS] * 3, 16, 16, 0.5, "cpu", True, 1),
        ([STEPS] * 2, 2, 2, None, "cpu", False, 1),
        ([STEPS, STEPS - 1], 2, 2, None, "cpu", True, 1),
        ([STEPS, STEPS - 1, STEPS], 4, 4, None, "cpu", True, 2),
        ([STEPS], 2, 2, None, "cpu", True, 1),
        ([], 2, 2, None, "cpu", True, 1),
        ([STEPS] * 2, 2, 2, None, "cuda", True, 1),
    ],
)
def test_how_many_at_once(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[int],
    threads: int,
    cores: int,
    memory: float | None,
    device: str,
    can_start: bool,
    expected: int,
) -> None:
    fits = [Fit(tiny_scene(), replace(CONFIG, iterations=each), "fit") for each in steps]
    there = None if memory is None or not fits else round(memory * side_by_side.process_bytes(fits[0]))
    monkeypatch.setattr(side_by_side, "MIN_STEPS", STEPS)
    monkeypatch.setattr(side_by_side.torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(
        side_by_side,
        "_processes",
        SimpleNamespace(
            can_start=lambda: can_start, usable_cores=lambda: cores, available_memory=lambda: there
        ),
    )
    assert side_by_side.at_once(fits, torch.device(device)) == expected
