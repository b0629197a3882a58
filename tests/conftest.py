"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import keyss  # noqa: F401  before any test module imports torch: see keyss._threads
from skip_policy import pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401  hooks


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
