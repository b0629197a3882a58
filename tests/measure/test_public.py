"""The names of `keyss.measure`, and that importing it loads nothing heavy."""

from __future__ import annotations

import subprocess
import sys

from keyss import measure

SCRIPT = """
import sys, keyss.measure
heavy = {"torch", "scipy", "sklearn", "ot"} & sys.modules.keys()
assert not heavy, heavy
import keyss.measure.two_sample, keyss.measure.sinkhorn
heavy = {"sklearn", "ot"} & sys.modules.keys()
assert not heavy, heavy
"""


def test_every_name_is_there() -> None:
    assert measure.__all__ == sorted(measure.__all__)
    assert all(callable(getattr(measure, name)) for name in measure.__all__)


def test_nothing_heavy_is_loaded_before_it_is_used() -> None:
    subprocess.run([sys.executable, "-c", SCRIPT], check=True)
