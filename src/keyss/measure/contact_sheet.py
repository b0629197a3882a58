"""Pictures in rows and columns, with names beside and above them."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

from PIL import Image, ImageDraw, ImageFont

from keyss.core.arrays import Bytes


def contact_sheet(heads: Sequence[str], rows: Mapping[str, Sequence[Bytes]], cell: int = 200) -> bytes:
    """A PNG file with rows of pictures [H, W, 3].

    Pictures are `cell` pixels high, with names on the left and `heads` above.
    """
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
    file = io.BytesIO()
    sheet.save(file, "PNG", optimize=True)
    return file.getvalue()
