"""A tab of headless Chromium, and a published model for all tests in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.viewer import export_html
from methods.carry.carried import embed, extract
from viewer.browser import KEYS, Visit, bright_model, visit


@pytest.fixture
def tab(chromium: Any) -> Iterator[Visit]:
    with visit(chromium) as found:
        yield found


@pytest.fixture(scope="session")
def stego(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of 4,000 Gaussians with two secrets of 200, whose keys cost what they do for users."""
    path = tmp_path_factory.mktemp("published") / "stego.ply"
    secrets = [(key, bright_model(200, seed)) for seed, key in enumerate(KEYS, start=1)]
    write_model(path, embed(bright_model(4000, 0), secrets, entropy=bytes(32)))
    return path


@pytest.fixture(scope="session")
def page_file(stego: Path) -> Path:
    return export_html(stego, stego.parent / "page.html")[0]


@pytest.fixture(scope="session")
def secrets(stego: Path) -> list[Gaussians]:
    return [extract(read_model(stego), key).gaussians for key in KEYS]
