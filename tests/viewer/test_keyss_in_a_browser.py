"""Secrets of the method keyss, by a decoder and in rows, end to end in headless Chromium."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import keyss
from keyss.channels import LOW_BITS
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.viewer import export_html
from methods.keyss.hiding import written
from viewer.browser import IN_CHROMIUM, Visit

pytestmark = IN_CHROMIUM

VECTOR, KEY = Path(__file__).parents[1] / "vectors" / "keyss.ply", "correct horse battery staple"


@pytest.fixture(scope="module")
def carriers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with a secret of the design `carriers`."""
    path = tmp_path_factory.mktemp("published") / "carriers.ply"
    stego, (secret,), _ = written(count=1400, rows=1600)
    write_model(path, LOW_BITS.prepare(stego).embed([(KEY, secret.payload())], entropy=bytes(32)))
    return path


def opened(tab: Visit, folder: Path) -> Gaussians:
    """The model that the key shows, as the page saves it."""
    tab.try_key(KEY)
    tab.saved("#download", folder / "secret.ply")
    return read_model(folder / "secret.ply")


def test_the_page_decodes_what_keyss_reveals(tab: Visit, tmp_path: Path) -> None:
    (page,) = export_html(VECTOR, tmp_path / "page.html")
    tab.goto(page.as_uri())
    found, expected = opened(tab, tmp_path), keyss.reveal(VECTOR, KEY).gaussians
    assert len(found) == len(expected)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-5)


def test_rows_are_what_keyss_reveals(tab: Visit, carriers: Path, tmp_path: Path) -> None:
    (page,) = export_html(carriers, tmp_path / "page.html")
    tab.goto(page.as_uri())
    tab.finds_nothing("another key")
    assert opened(tab, tmp_path).digest() == keyss.reveal(carriers, KEY).gaussians.digest()


@pytest.mark.alone
def test_a_wrong_key_takes_as_long_as_one_that_opens_rows(tab: Visit, carriers: Path, tmp_path: Path) -> None:
    (page,) = export_html(carriers, tmp_path / "page.html")
    tab.goto(page.as_uri())
    tab.takes_as_long_for_each("wrong", KEY, "wrong again", KEY, "and again")
