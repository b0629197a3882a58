"""Fixtures for reports."""

from __future__ import annotations

from pathlib import Path

import pytest

from report.audits import audit, write_run


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a whole audit; tests must not change it."""
    return write_run(tmp_path_factory.mktemp("run"), audit())
