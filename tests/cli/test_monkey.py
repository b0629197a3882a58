"""What holds after random calls on random files: see `monkey.py`. A failure prints the seed and the calls."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli.monkey import Monkey


def test_some_random_calls(tmp_path: Path) -> None:
    monkey = Monkey(tmp_path, seed=11)
    monkey.play(20)
    assert {0, 2, 4, 5} <= monkey.statuses.keys()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_thousand_random_calls(tmp_path: Path, seed: int) -> None:
    monkey = Monkey(tmp_path, seed=seed)
    monkey.play(250)
    assert {0, 2, 3, 4, 5} <= monkey.statuses.keys()
