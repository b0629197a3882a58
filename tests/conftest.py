"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

import keyss  # noqa: F401  before any test module imports torch: see keyss._threads
from alone import pytest_runtest_protocol  # noqa: F401  hook
from cheap_keys import pytest_runtest_setup, pytest_sessionstart  # noqa: F401  hooks
from skip_policy import pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401  hooks

# What hypothesis makes up is the same in every run of CI, so that a failure comes with the change that made
# it; on other machines it goes on searching.
settings.register_profile("ci", derandomize=True)
if "CI" in os.environ:
    settings.load_profile("ci")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scenes (`fox`, `lego`, ...), or a skip where there is none.

    It is looked for in KEYSS_TEST_DATA, else in `../shared/data` beside the repository.
    """
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("KEYSS_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real scenes in {folder} (set KEYSS_TEST_DATA to their folder)")
    return folder
