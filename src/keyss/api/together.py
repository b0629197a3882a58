"""Functions that several processes of torchrun run together; see `keyss.fitting.ranks`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import msgspec

from keyss.fitting.config import FitConfig
from keyss.fitting.ranks import here, joined
from keyss.runs.folder import recorded_number

P = ParamSpec("P")
R = TypeVar("R")


def together(verb: Callable[P, R]) -> Callable[P, R]:
    """Let all processes of torchrun join in `verb`, which takes `device`."""

    @wraps(verb)
    def joining(*arguments: P.args, **options: P.kwargs) -> R:
        with joined(str(options.get("device", "auto"))):
            return verb(*arguments, **options)

    return joining


def begun(config: FitConfig, interrupted: Path | None, *names: str) -> FitConfig:
    """`config` with a seed and a number of views, the same in all processes.

    A resumed run takes them from the `interrupted` run's folder, in whose arguments its config is found by
    `names`. Otherwise the default is a random seed, and one view for each process. Raises UsageError if the
    views cannot be divided evenly.
    """
    ranks = here()
    if interrupted is not None and ranks.first:
        config = config.seeded(recorded_number(interrupted, *names, "seed"))
        if config.views_per_step is None:
            views = recorded_number(interrupted, *names, "views_per_step")
            config = replace(config, views_per_step=views)
    config = config.seeded()
    if ranks.count == 1:
        return config
    config = replace(config, views_per_step=ranks.views(config.views_per_step))
    return msgspec.json.decode(ranks.from_first(msgspec.json.encode(config)), type=FitConfig)
