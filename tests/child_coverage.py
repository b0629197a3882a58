"""Coverage counts what processes do that tests start, only for tests marked `counted`.

Such a process loads torch, numba and scipy, for which it takes a third longer under coverage. Nearly all that
it reaches of keyss is reached in the tests' own process as well; `counted` are a few tests of what is not.
"""

from __future__ import annotations

import os

import pytest

VARIABLE = "COVERAGE_PROCESS_CONFIG"  # how `patch = subprocess` of coverage.py tells processes to count
_setting: str | None = None


def count_or_not(item: pytest.Item) -> None:
    """For the processes that the test and its fixtures start from now on."""
    global _setting
    _setting = os.environ.pop(VARIABLE, _setting)
    if _setting is not None and item.get_closest_marker("counted") is not None:
        os.environ[VARIABLE] = _setting
