"""The public functions that train and measure, for commands."""

from __future__ import annotations

from typing import Any


def verb(name: str) -> Any:
    """The function `name` of `keyss`; a line says that it is loaded, as importing torch takes seconds."""
    import keyss
    from keyss.progress import waiting

    with waiting("starting", 2.0):
        return getattr(keyss, name)
