"""Progress lines."""

from __future__ import annotations

import io
import re
import time

import pytest
from rich.console import Console

from keyss.progress import ProgressLines, Wait, clock, reporter


class Timer:
    """A clock set by the test."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def timer() -> Timer:
    return Timer()


def console(terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, color_system=None, width=120)


def text(of: Console) -> str:
    assert isinstance(of.file, io.StringIO)
    return of.file.getvalue()


def test_live_only_on_terminals() -> None:
    assert reporter(console(True)).live
    assert not reporter(console(False)).live


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00"), (59.6, "1:00"), (302, "5:02"), (3723, "1:02:03"), (-1, "0:00")]
)
def test_clock(seconds: float, shown: str) -> None:
    assert clock(seconds) == shown


def wait_for(log: Console, words: str) -> None:
    for _ in range(500):
        if words in text(log):
            return
        time.sleep(0.02)
    raise AssertionError(f"{words} not in {text(log)}")


def test_log_lines(timer: Timer) -> None:
    log = console(False)
    lines = ProgressLines(log, every=0.01, timer=timer)
    lines.start("hide", 300, 0)
    for iteration in range(1, 101):
        lines.update(iteration, 12345, {"PSNR cover": 25.127})
        timer.now += 0.25
        if iteration % 40 == 0:
            wait_for(log, f"hide: {iteration}/300, ")
    lines.finish()
    lines.finish()
    first, *shown, last = text(log).splitlines()
    assert first == "hide: 300 steps"
    line = r"hide: 40/300, [34]\.\d it/s, 1:\d\d left, 12,345 Gaussians, PSNR cover 25.13"
    assert any(re.fullmatch(line, each) for each in shown), shown
    assert last == "hide: stopped at 100 in 0:25, 12,345 Gaussians, PSNR cover 25.13"


def test_first_steps_are_not_silent() -> None:
    """The first step compiles kernels, which takes long on a busy machine."""
    log = console(False)
    lines = ProgressLines(log, every=0.01)
    lines.start("hide", 300, 0)
    wait_for(log, "hide: 0/300, starting")
    lines.finish()
    before = text(log)
    time.sleep(0.05)
    assert text(log) == before


def test_short_waits_do_not_add_up_to_silence() -> None:
    log = console(False)
    lines = ProgressLines(log, every=0.2)
    start = time.monotonic()
    while not text(log):
        with lines.waiting("one of many", 0.1):
            time.sleep(0.01)
        assert time.monotonic() - start < 10
    assert time.monotonic() - start >= 0.2
    assert text(log).startswith("one of many: 0:00")


def test_live_line(timer: Timer) -> None:
    screen = console(True)
    line = ProgressLines(screen, timer=timer)
    line.start("hide", 300, 0)
    for iteration in range(1, 301):
        timer.now += 0.1
        line.update(iteration, 12345, {"PSNR cover": 25.127})
    line.finish()
    line.finish()
    shown = text(screen)
    assert "150/300 10.0 it/s, 0:15 left, 12,345 Gaussians, PSNR cover 25.13" in shown
    assert shown.count("12,345") < 150
    assert "300/300 in 0:30, 12,345 Gaussians, PSNR cover 25.13" in shown


@pytest.mark.parametrize("terminal", [True, False])
def test_reporter_is_reusable(timer: Timer, terminal: bool) -> None:
    screen = console(terminal)
    lines = ProgressLines(screen, timer=timer)
    for title in ("cover", "secret"):
        lines.start(title, 2, 0)
        timer.now += 1
        lines.update(2, 0, {})
        lines.finish()
    assert [text(screen).count(title) > 1 for title in ("cover", "secret")] == [True, True]


def test_time_left_follows_the_pace_of_the_work(timer: Timer) -> None:
    wait = Wait("audit", 60, timer)
    assert str(wait) == "audit: 0:00, about 60 s left"
    timer.now += 20
    assert str(wait) == "audit: 0:20, about 40 s left"  # nothing else is known
    wait.update(1 / 3)
    assert wait.left == pytest.approx(40)
    timer.now += 40
    wait.update(0.5)  # a half took a minute
    assert wait.left == pytest.approx(60)
    timer.now += 70
    assert str(wait) == "audit: 2:10, longer than estimated"


def test_long_waits_are_logged() -> None:
    log = console(False)
    with ProgressLines(log, every=0.05).waiting("checking a.ply", 100):
        wait_for(log, "checking a.ply: 0:0")
    assert " left" in text(log)
    before = text(log)
    with ProgressLines(log).waiting("nothing to do", 100):
        time.sleep(0.1)
    assert text(log) == before


def test_only_long_waits_are_displayed_in_terminals(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = console(True)
    with ProgressLines(screen).waiting("nothing to do", 100):
        pass
    assert text(screen) == ""
    monkeypatch.setattr("keyss.progress._DELAY_SECONDS", 0.01)
    with ProgressLines(screen).waiting("checking a.ply", 100) as share:
        share(0.5)
        for _ in range(500):
            time.sleep(0.02)
            if text(screen):
                break
    assert "checking a.ply: 0:0" in text(screen)
