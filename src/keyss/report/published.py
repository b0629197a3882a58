"""The published model in a report: the viewer in a frame, or where else it can be looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from keyss.viewer.page import page_with
from keyss.viewer.showing import is_shown

MOST_EMBEDDED = 32 << 20  # bytes; 130,000 Gaussians of SH degree 3


@dataclass(frozen=True)
class Published:
    """What a report says of the published model."""

    path: str
    page: str | None  # the whole page of the viewer with the model in it
    why_not: str = ""  # there is none: a sentence


def published_model(path: Path, up: str) -> Published:
    """The viewer with a model of at most 32 MiB: what is larger makes a report that takes long to open."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_EMBEDDED + 1)
    except OSError:
        return Published(str(path), None, "It is not where it was, or cannot be read.")
    if len(data) > MOST_EMBEDDED:
        return Published(str(path), None, f"It has more than {MOST_EMBEDDED >> 20} MiB, too many here.")
    if not is_shown(path.name, data):
        return Published(str(path), None, "It is no model that the viewer reads.")
    return Published(str(path), page_with(data, path.name, up).decode())
