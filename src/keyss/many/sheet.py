"""Pictures in rows and columns: a comparison of methods, and the demo's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from keyss.measure.images import renders_of
from keyss.rendering import Backend, resolve_device
from keyss.runs.opening import HidingRun

Picture = NDArray[np.uint8]  # [H, W, 3]


def comparison_sheet(runs: Mapping[str, HidingRun], device: Backend) -> Image.Image:
    """A row for each method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: dict[str, Sequence[Picture]] = {}
    for name, run in runs.items():
        stego = run.stego.to(target)
        models = [stego, run.opened[0].reveal(stego).to(target)]
        photos, renders = [], []
        for scene, model in zip(run.scenes(train_pictures=False), models, strict=True):
            view = scene.test[len(scene.test) // 2]
            photos.append(view.image.numpy())
            renders.append(renders_of(model, scene, [view])[0][1].numpy())
        error = np.abs(photos[1].astype(int) - renders[1]).clip(0, 63).astype(np.uint8) * 4
        rows.setdefault("photos", [*photos, np.zeros_like(error)])
        rows[name] = [*renders, error]
    return contact_sheet(["cover", "secret", "error of the secret, x4"], rows)


def contact_sheet(
    heads: Sequence[str], rows: Mapping[str, Sequence[Picture]], cell: int = 200
) -> Image.Image:
    """Rows of pictures, each `cell` pixels high, beside the names of the rows and below heads."""
    gap, font = cell // 40, ImageFont.load_default(cell // 14)
    scaled = [
        [
            Image.fromarray(each).resize((max(1, round(each.shape[1] * cell / each.shape[0])), cell))
            for each in pictures
        ]
        for pictures in rows.values()
    ]
    label = max(math.ceil(font.getlength(name)) for name in rows) + gap
    lines = 1 + max(head.count("\n") for head in heads)
    top = gap + lines * (cell // 8)
    widths = [
        max(
            *(math.ceil(font.getlength(line)) for line in ["", *head.split("\n")]),
            *(each.width for each in column),
        )
        for head, column in zip(heads, zip(*scaled, strict=True), strict=True)
    ]
    starts = [label + gap + sum(widths[:index]) + gap * index for index in range(len(widths))]
    size = starts[-1] + widths[-1] + gap, top + (cell + gap) * len(rows)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for x, head in zip(starts, heads, strict=True):
        draw.multiline_text((x, gap), head, fill=(20, 20, 20), font=font)
    for number, (name, pictures) in enumerate(zip(rows, scaled, strict=True)):
        y = top + (cell + gap) * number
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for x, picture in zip(starts, pictures, strict=True):
            sheet.paste(picture, (x, y))
    return sheet
