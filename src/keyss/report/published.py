"""The published model in a report: the viewer in a frame, or how else it can be looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from keyss.viewer.page import page_with
from keyss.viewer.showing import is_shown

MOST_EMBEDDED = 32 << 20  # bytes; 130,000 Gaussians of SH degree 3


@dataclass(frozen=True)
class Published:
    """What a report says of the published model."""

    page: str | None  # the whole page of the viewer with the model in it
    instead: str = ""  # where there is none: sentences


def published_model(path: Path, up: str) -> Published:
    """The viewer with a run's published model, of at most 32 MiB: with more, a report takes long to open."""
    how = f"`keyss view RUN/publish/{path.name}` shows it."
    inside = path.resolve().parent == path.parent.parent.resolve() / path.parent.name  # no link to elsewhere
    try:
        with path.open("rb") as file:
            data = file.read(MOST_EMBEDDED + 1) if inside else b""
    except OSError:
        data = b""
    if not is_shown(path.name, data):
        return Published(None, "It was not in RUN/publish when this page was written.")
    if len(data) > MOST_EMBEDDED:
        return Published(None, f"It has more than {MOST_EMBEDDED >> 20} MiB, too many for this page. {how}")
    return Published(page_with(data, path.name, up).decode())
