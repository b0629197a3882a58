"""Other programs that read and write the formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from keyss.core import BackendError
from keyss.measure import find_splat_transform, transform

NEWER = Path(__file__).parents[2] / "web" / "node_modules" / ".bin" / "splat-transform"


@pytest.fixture(scope="session")
def splat_transform() -> Callable[..., Path]:
    """Converts (source, target) -> target by splat-transform; skips if it is not installed."""
    try:
        find_splat_transform()
    except BackendError as error:
        pytest.skip(str(error))
    return transform


@pytest.fixture
def splat_transform_3(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """The same by version 3, which the viewer's tests install."""
    if not NEWER.exists():
        pytest.skip("no web/node_modules: `make test-web` installs splat-transform 3")
    monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(NEWER))
    return transform
