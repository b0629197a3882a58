"""Other people's programs, which judge what is written and write what is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from keyss.core.errors import BackendError
from keyss.measure.robustness.conversions import find_splat_transform, transform


@pytest.fixture(scope="session")
def splat_transform() -> Callable[..., Path]:
    """(source, target) -> target, converted by splat-transform, or a skip where it is not installed."""
    try:
        find_splat_transform()
    except BackendError as error:
        pytest.skip(str(error))
    return transform
