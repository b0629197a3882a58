"""With CI=true, a test that skips because a tool is missing fails."""

from __future__ import annotations

import os
import re
from collections.abc import Generator
from typing import TypeVar

import pytest

# Reasons for which tests may skip on CI.
ALLOWED = (
    r"CUDA",  # CI has no GPU
    r"no real scenes in ",  # photos are not part of the repository
)

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return fail_skips((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return fail_skips((yield))


def fail_skips(report: Report) -> Report:
    """Turn a skip that CI does not allow into a failure."""
    if os.environ.get("CI") != "true" or not report.skipped or hasattr(report, "wasxfail"):
        return report
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    if not any(re.search(pattern, reason) for pattern in ALLOWED):
        report.outcome = "failed"
        report.longrepr = f"skipped on CI, where everything must run: {reason.removeprefix('Skipped: ')}"
    return report
