"""An audited run."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.audits.audited import audited_run
from shared import make_once


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a whole audit; tests must not change it."""
    return make_once(tmp_path_factory, "audited", audited_run) / "run"
