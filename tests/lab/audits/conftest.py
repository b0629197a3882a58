"""Fixtures for reports."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from lab.audits.audited import audited_run, found_in
from shared import make_once


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a whole audit; tests must not change it, but may write its report."""
    made = make_once(tmp_path_factory, "audited", audited_run)
    return shutil.copytree(made / "run", tmp_path_factory.mktemp("audited") / "run")


@pytest.fixture
def data(run_folder: Path) -> dict[str, Any]:
    """The JSON of that audit, to be changed."""
    return found_in(run_folder)
