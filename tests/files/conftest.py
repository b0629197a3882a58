"""Other programs that read and write the formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from keyss.lab import transform

NEWER = Path(__file__).parents[2] / "web" / "node_modules" / ".bin" / "splat-transform"


@pytest.fixture
def splat_transform_3(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """`splat_transform` of version 3, which the viewer's tests install."""
    if not NEWER.exists():
        pytest.skip("no web/node_modules: `make test-web` installs splat-transform 3")
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(NEWER))
    return transform
