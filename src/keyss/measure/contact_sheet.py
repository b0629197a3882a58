"""Pictures in rows and columns, with names beside and above them."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from keyss.core.arrays import Bytes


def contact_sheet(heads: Sequence[str], rows: Mapping[str, Sequence[Bytes]], cell: int = 200) -> bytes:
    """A PNG file with rows of pictures [H, W, 3].

    Pictures are `cell` pixels high, with names on the left and `heads` above, wrapped to the width of their
    column.
    """
    gap, font = cell // 40, ImageFont.load_default(cell // 14)
    scaled = [
        [
            Image.fromarray(picture).resize((max(1, round(picture.shape[1] * cell / picture.shape[0])), cell))
            for picture in pictures
        ]
        for pictures in rows.values()
    ]
    left = math.ceil(max(map(font.getlength, rows))) + 2 * gap
    widths = [
        max(
            *(math.ceil(font.getlength(word)) for word in head.split()),
            *(picture.width for picture in pictures),
        )
        for head, pictures in zip(heads, zip(*scaled, strict=True), strict=True)
    ]
    wrapped = [_wrapped(head, width, font) for head, width in zip(heads, widths, strict=True)]
    places = [left + sum(widths[:column]) + gap * column for column in range(len(heads))]
    top = gap + (1 + max(head.count("\n") for head in wrapped)) * (cell // 8)
    size = (left + sum(widths) + gap * len(heads), top + (cell + gap) * len(rows))
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for place, head in zip(places, wrapped, strict=True):
        draw.multiline_text((place, gap), head, fill=(20, 20, 20), font=font)
    for row, (name, pictures) in enumerate(zip(rows, scaled, strict=True)):
        y = top + (cell + gap) * row
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for place, picture in zip(places, pictures, strict=True):
            sheet.paste(picture, (place, y))
    file = io.BytesIO()
    sheet.save(file, "PNG", optimize=True)
    return file.getvalue()


def _wrapped(text: str, width: int, font: Any) -> str:
    """`text` with line breaks between words, so that lines are at most `width` pixels wide."""
    lines = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}".strip()
            if line and font.getlength(longer) > width:
                lines.append(line)
                longer = word
            line = longer
        lines.append(line)
    return "\n".join(lines)
