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
    lines = [line for head in heads for line in head.split("\n")]
    left = math.ceil(max(map(font.getlength, rows))) + 2 * gap
    top = gap + (1 + max(head.count("\n") for head in heads)) * (cell // 8)
    widest = max(math.ceil(font.getlength(line)) for line in lines)
    width = gap + max(widest, *(each.width for pictures in scaled for each in pictures))
    sheet = Image.new("RGB", (left + width * len(heads), top + (cell + gap) * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    for column, head in enumerate(heads):
        draw.multiline_text((left + width * column, gap), head, fill=(20, 20, 20), font=font)
    for row, (name, pictures) in enumerate(zip(rows, scaled, strict=True)):
        y = top + (cell + gap) * row
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for column, picture in enumerate(pictures):
            sheet.paste(picture, (left + width * column, y))
    file = io.BytesIO()
    sheet.save(file, "PNG", optimize=True)
    return file.getvalue()
