"""Chromium for a module of tests, and a new tab for each test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from viewer.browser import PATIENCE, PROGRAM, SWITCHES, Visit, visit


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=PROGRAM, args=SWITCHES, timeout=PATIENCE)
        yield browser
        browser.close()


@pytest.fixture
def tab(chromium: Any) -> Iterator[Visit]:
    with visit(chromium) as found:
        yield found
