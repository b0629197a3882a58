"""Progress of a training: lines, and with --live a local page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from keyss.progress import Reporter, reporter as lines


@contextmanager
def reporting(scene: Path, live: bool) -> Iterator[Reporter]:
    """The reporter of `fit` and `hide`. With `live`, a page shows the training within the context.

    Raises OutputError if the page cannot be served.
    """
    if not live:
        yield lines()
        return
    from keyss.viewer.live import LiveTraining
    from keyss.viewer.look import look_of_scene

    with LiveTraining(look_of_scene(scene)) as page:
        print(f"{page.address} shows the training; only this machine can open it", flush=True)
        yield page.reporter(lines())
