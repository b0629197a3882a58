"""What lies in a folder of results: names of files, and what writes and reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.files.atomic import write_bytes
from keyss.files.images import png_bytes
from keyss.files.models import write_model
from keyss.runs.records import write_record

STEGO, SIDECAR, CONFIG, METRICS, MODEL = (
    "stego.ply",
    "decoder.sealed",
    "config.json",
    "metrics.json",
    "model.ply",
)
PRIVATE = "private"  # plain models of cover and secrets: for measuring, never to be published


def plain_names(secrets: int) -> list[str]:
    """Files of the plain models of the cover and of so many secrets."""
    return [f"{PRIVATE}/cover.ply"] + [f"{PRIVATE}/secret-{index}.ply" for index in range(1, secrets + 1)]


def ply_writer(gaussians: Gaussians) -> Callable[[Path], None]:
    """For `OutputFolder.fill`: writes a model."""
    return lambda path: write_model(path, gaussians)


def bytes_writer(data: bytes) -> Callable[[Path], None]:
    """For `OutputFolder.fill`: writes bytes."""
    return lambda path: write_bytes(path, data)


def png_writer(image: Tensor) -> Callable[[Path], None]:
    """For `OutputFolder.fill`: writes an image [H, W, 3] uint8."""
    return bytes_writer(png_bytes(image))


def record_writer(record: Any) -> Callable[[Path], None]:
    """For `OutputFolder.fill`: writes a record."""
    return lambda path: write_record(path, record)
