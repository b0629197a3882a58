"""The picture of a comparison: a row for each method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from keyss.measure.images import renders_of
from keyss.rendering import Backend, resolve_device
from keyss.runs.opening import HidingRun

_TITLES = ("cover", "secret", "error of the secret, x4")


def sheet(runs: Mapping[str, HidingRun], device: Backend) -> Image.Image:
    """A row for each method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: list[tuple[str, list[NDArray[np.uint8]]]] = []
    for name, run in runs.items():
        stego = run.stego.to(target)
        shown = []
        for scene, model in zip(
            run.scenes(train_pictures=False), [stego, run.opened[0].reveal(stego).to(target)], strict=True
        ):
            view = scene.test[len(scene.test) // 2]
            shown.append((view.image.numpy(), renders_of(model, scene, [view])[0][1].numpy()))
        error = np.abs(shown[1][0].astype(int) - shown[1][1]).clip(0, 63).astype(np.uint8) * 4
        if not rows:
            rows.append(("photos", [shown[0][0], shown[1][0], np.zeros_like(error)]))
        rows.append((name, [shown[0][1], shown[1][1], error]))
    return _drawn(rows)


def _drawn(rows: Sequence[tuple[str, Sequence[NDArray[np.uint8]]]], cell: int = 200) -> Image.Image:
    """Rows of pictures [H, W, 3], each `cell` pixels high, beside their names."""
    gap, label, head = cell // 40, cell // 2, cell // 8
    pictures = [[Image.fromarray(each) for each in own] for _, own in rows]
    scaled = [
        [each.resize((max(1, round(each.width * cell / each.height)), cell)) for each in own]
        for own in pictures
    ]
    font = ImageFont.load_default(cell // 14)
    widths = [
        max(math.ceil(font.getlength(title)), *(each.width for each in column))
        for title, column in zip(_TITLES, zip(*scaled, strict=True), strict=True)
    ]
    size = label + sum(widths) + gap * (len(widths) + 1), head + (cell + gap) * len(rows) + gap
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    starts = [label + sum(widths[:index]) + gap * index for index in range(len(widths))]
    for x, text in zip(starts, _TITLES, strict=True):
        draw.text((x, gap), text, fill=(20, 20, 20), font=font)
    for number, ((name, _), own) in enumerate(zip(rows, scaled, strict=True)):
        y = head + (cell + gap) * number
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for x, each in zip(starts, own, strict=True):
            sheet.paste(each, (x, y))
    return sheet
