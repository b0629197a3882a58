"""Cells in other processes are fake, unless a test says otherwise."""

from __future__ import annotations

import pytest

from keyss.many import engines
from many.fakes import fake


@pytest.fixture(autouse=True)
def _fake_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "WORKER", fake())
