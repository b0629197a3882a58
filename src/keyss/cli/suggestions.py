"""What somebody may have meant who misspelt a command, an option or a path."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from keyss.core.nearest import nearest

_MOST_NAMES = 10_000  # of a folder that are compared, so that an error comes at once


def meant(arguments: Sequence[str], commands: Collection[str], options: Collection[str]) -> str | None:
    """What the arguments of a wrong call should perhaps have been, in a few words; None without an idea."""
    command, *others = arguments
    if command not in commands:
        near = nearest(command.lower(), commands)
        return near and f"`keyss {near}`"
    flags = {word.partition("=")[0] for word in others if word.startswith("--")} - {"--help"}
    found = {flag: nearest(flag, options) for flag in sorted(flags - set(options))}
    return ", ".join(f"{near} instead of {flag}" for flag, near in found.items() if near) or None


def options_of(command: Callable[..., Any]) -> set[str]:
    """Of a command all that begins with two dashes: its options, and their other names."""
    found = set()
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        if parameter.kind is not parameter.KEYWORD_ONLY:
            continue
        for extra in getattr(parameter.annotation, "__metadata__", ()):
            name = getattr(extra, "name", None) or name
            found |= {alias for alias in getattr(extra, "aliases", None) or () if alias.startswith("--")}
        found.add(f"--{name.replace('_', '-')}")
    return found


def existing_path(message: str, arguments: Sequence[str]) -> str | None:
    """Of the arguments that `message` names one that is no path, spelt as one that is; None without any."""
    for word in arguments:
        if word.startswith("-") or len(word) > 4096 or str(Path(word)) not in message:
            continue
        try:
            if not os.path.lexists(word) and (near := _near_path(Path(word))) is not None:
                return str(near)
        except (OSError, ValueError):
            continue
    return None


def _near_path(path: Path) -> Path | None:
    """`path` with its parts replaced by the nearest that are there, from the first that is not."""
    found = Path(path.anchor)
    for part in path.relative_to(path.anchor).parts:
        if not (found / part).exists():
            near = nearest(part, list(_names(found)))
            if near is None:
                return None
            part = near
        found /= part
    return found


def _names(folder: Path) -> Iterator[str]:
    with os.scandir(folder) as entries:
        yield from (entry.name for entry in islice(entries, _MOST_NAMES))
