"""A tab of headless Chromium per test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from viewer.browser import Visit, visit


@pytest.fixture
def tab(chromium: Any) -> Iterator[Visit]:
    with visit(chromium) as found:
        yield found
