"""`--live`: a page of this machine that shows the model as it trains."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from keyss.cli.ranks import answers

if TYPE_CHECKING:
    from keyss.fitting.loop import Reporter


@contextmanager
def watched(told: Reporter, scene: Path, *, live: bool) -> Iterator[Reporter]:
    """What a training of `scene` reports to: `told`, and where it is asked for a page as well.

    The page is there while the context is. Raises OutputError where it cannot be served.
    """
    if not (live and answers()):
        yield told
        return
    from keyss.files.layout import usual_up
    from keyss.viewer.live import LiveTraining

    with LiveTraining(usual_up(scene)) as training:
        print(
            f"{training.address} shows the training as it is, to whoever on this machine knows this address",
            flush=True,
        )
        yield training.reporter(told)
