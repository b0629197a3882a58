"""Contact sheets."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from keyss.measure.renders import contact_sheet


def test_headings_fit() -> None:
    narrow = [np.zeros((40, 2, 3), np.uint8)] * 3
    picture = contact_sheet(["cover", "secret", "error of the secret"], {"photos": narrow})
    right = np.asarray(Image.open(io.BytesIO(picture)))[:25, -4:]  # the gap right of the last heading
    assert (right == 255).all()


def test_layout() -> None:
    red, blue = (np.full((3, 4, 3), color, np.uint8) for color in ((255, 0, 0), (0, 0, 255)))
    file = contact_sheet(["left", "right"], {"": [red, blue], "2": [red, blue]}, cell=60)
    picture = np.asarray(Image.open(io.BytesIO(file)))
    assert (picture[-61:-1, -162:-82] == (255, 0, 0)).all()
    assert (picture[-122:-62, -81:-1] == (0, 0, 255)).all()
    assert (picture[:-124] != 255).any()


def test_narrow_pictures_have_no_gaps() -> None:
    """A long heading wraps; a column is no wider than its pictures."""
    portrait = np.zeros((200, 110, 3), np.uint8)
    picture = contact_sheet(["the cover as a photo of it", "the published model"], {"1": [portrait] * 2})
    row = (np.asarray(Image.open(io.BytesIO(picture)))[-100] == 0).all(1)
    columns = np.flatnonzero(row)
    assert len(columns) == 220
    assert columns[110] - columns[109] <= 200 // 40 + 1
