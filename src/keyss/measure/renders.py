"""Renders of models as 8-bit images, and sheets of them."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping, Sequence

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from keyss.core import Camera, Gaussians, View
from keyss.core.arrays import Bytes
from keyss.files.images import png_names
from keyss.fitting.image_metrics import subsample_views
from keyss.methods.method import Source, role_of
from keyss.rendering import render
from keyss.rendering.orbit import from_above


def select_views(views: Sequence[View]) -> list[View]:
    """At most 64 views, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), 64))


@torch.no_grad()
def renders_of(model: Gaussians, cameras: Sequence[Camera], background: Tensor) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model over a background [3]."""
    background, renders = background.to(model.device), []
    for name, camera in zip(png_names(cameras), cameras, strict=True):
        image = render(model, camera, background).clamp(0, 1)
        renders.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return renders


def sheet_of(models: Sequence[Gaussians], sources: Sequence[Source]) -> bytes:
    """A PNG of three test views of cover and secrets: images, and renders of the models after hiding."""
    heads: list[str] = []
    pictures: list[list[Bytes]] = []
    for index, (model, source) in enumerate(zip(models, sources, strict=True)):
        role, kind = role_of(index, len(sources)), "photo" if source.photos else "given model"
        scene = source.scene if source.photos else from_above(source.scene)
        shown = subsample_views(scene.test, 3)
        renders = renders_of(model, [view.camera for view in shown], scene.background)
        heads += [f"{role}, {kind}", f"{role}, {'revealed' if index else 'published'}"]
        pictures += [[view.image.numpy() for view in shown], [image.numpy() for _, image in renders]]
    count = min(map(len, pictures))
    rows = {f"view {row + 1}": [column[row] for column in pictures] for row in range(count)}
    return contact_sheet(heads, rows)


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
    letter, wrapped, widths = font.getlength("n"), [], []
    for head, column in zip(heads, zip(*scaled, strict=True), strict=True):
        width = max(picture.width for picture in column)
        lines = [
            line
            for part in head.split("\n")
            for line in textwrap.wrap(part, max(1, int(width / letter)), break_long_words=False)
        ]
        wrapped.append("\n".join(lines))
        widths.append(max(width, *(math.ceil(font.getlength(line)) for line in lines)))
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
