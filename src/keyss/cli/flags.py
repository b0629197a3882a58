"""Names of arguments in Python and on the command line."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection
from dataclasses import is_dataclass
from typing import Any, get_type_hints

# Between backticks: `overwrite=True`, `method="carry", dither=True`, `sh_degree`.
_VALUE = r"""(?:"[^"`]*"|'[^'`]*'|[\w.+-]+)"""
_ASSIGNMENT = rf"([A-Za-z_]\w*)=({_VALUE})"
_ASSIGNMENTS = re.compile(rf"`({_ASSIGNMENT}(?:, ?{_ASSIGNMENT})*)`")
_NAME = re.compile(r"`([a-z_]\w*)`")

# Arguments whose flags have another name.
_RENAMED = {"key": "key-file", "keys": "key-file", "secrets": "secret", "model": "secret-model"}
_RENAMED |= {"download_scenes": "download"}


def as_flags(message: str, options: Collection[str]) -> str:
    """`message` with flags in place of the arguments that it names between backticks.

    Names without a value are replaced only if they are in `options`, since they may be anything else.
    """

    def assignments(found: re.Match[str]) -> str:
        return " ".join(_flag(name, value) for name, value in re.findall(_ASSIGNMENT, found[1]))

    def name(found: re.Match[str]) -> str:
        known = found[1] in options or _RENAMED.get(found[1], "").replace("-", "_") in options
        return _flag(found[1], "True") if known else found[0]

    return _NAME.sub(name, _ASSIGNMENTS.sub(assignments, message))


def _flag(name: str, value: str) -> str:
    flag = f"--{_RENAMED.get(name, name.replace('_', '-'))}"
    match value:
        case "True":
            return flag
        case "False" | "None":
            return f"no {flag}"
    return f"{flag} {value.strip(chr(34) + chr(39))}"


def options_of(command: Callable[..., Any]) -> dict[str, Any]:
    """The options of a command with their types, those of groups included."""
    found: dict[str, Any] = {}
    for each in inspect.signature(command, eval_str=True).parameters.values():
        if is_dataclass(group := getattr(each.annotation, "__origin__", each.annotation)):
            found |= _options_of_group(group)
        elif each.kind is each.KEYWORD_ONLY:
            found[each.name.rstrip("_")] = each.annotation
    return found


def _options_of_group(group: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(group, include_extras=True).items():
        nested = getattr(hint, "__origin__", hint)
        found |= _options_of_group(nested) if is_dataclass(nested) else {name: hint}
    return found
