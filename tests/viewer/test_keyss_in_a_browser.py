"""A secret whose key opens a decoder, end to end in headless Chromium."""

from __future__ import annotations

from pathlib import Path

import torch

import keyss
from keyss.files import read_model
from keyss.viewer import export_html
from viewer.browser import IN_CHROMIUM, Visit

pytestmark = IN_CHROMIUM

VECTOR, KEY = Path(__file__).parents[1] / "vectors" / "keyss.ply", "correct horse battery staple"


def test_the_page_decodes_what_keyss_reveals(tab: Visit, tmp_path: Path) -> None:
    (page,) = export_html(VECTOR, tmp_path / "page.html")
    tab.goto(page.as_uri())
    tab.try_key(KEY)
    tab.saved("#download", tmp_path / "secret.ply")
    found, expected = read_model(tmp_path / "secret.ply"), keyss.reveal(VECTOR, KEY).gaussians
    assert len(found) == len(expected)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-5)
