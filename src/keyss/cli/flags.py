"""Arguments as they are named in Python, turned into those of the command line."""

from __future__ import annotations

import re
from collections.abc import Collection

# Between backticks: `overwrite=True`, `method="carry", dither=True`, `sh_degree`.
_VALUE = r"""(?:"[^"`]*"|'[^'`]*'|[\w.+-]+)"""
_ASSIGNMENT = rf"([A-Za-z_]\w*)=({_VALUE})"
_ASSIGNMENTS = re.compile(rf"`({_ASSIGNMENT}(?:, ?{_ASSIGNMENT})*)`")
_NAME = re.compile(r"`([a-z_]\w*)`")

# Named otherwise on the command line.
_OTHERWISE = {"key": "key-file", "keys": "key-file", "secrets": "secret", "model": "secret-model"}
_OTHERWISE |= {"download_scenes": "download"}


def as_flags(message: str, options: Collection[str]) -> str:
    """`message` with flags for the arguments that it names.

    Names alone are flags only if they are among `options`, those of the command in Python's spelling: what
    stands between backticks may be anything else. Assignments always are.
    """

    def assignments(found: re.Match[str]) -> str:
        return " ".join(_flag(name, value) for name, value in re.findall(_ASSIGNMENT, found[1]))

    def name(found: re.Match[str]) -> str:
        known = found[1] in options or _OTHERWISE.get(found[1], "").replace("-", "_") in options
        return _flag(found[1], "True") if known else found[0]

    return _NAME.sub(name, _ASSIGNMENTS.sub(assignments, message))


def _flag(name: str, value: str) -> str:
    flag = f"--{_OTHERWISE.get(name, name.replace('_', '-'))}"
    match value:
        case "True":
            return flag
        case "False" | "None":
            return f"no {flag}"
    return f"{flag} {value.strip(chr(34) + chr(39))}"
