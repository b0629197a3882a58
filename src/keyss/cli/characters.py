"""Replacements for characters that an output cannot encode, such as one in ASCII or an old code page."""

from __future__ import annotations

import codecs

_PLAIN = {
    **dict.fromkeys("•·×", "*"),
    **dict.fromkeys("─━╸╺╴╶—–−", "-"),
    **dict.fromkeys("│┃╎", "|"),
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+"),
    **dict.fromkeys("‘’", "'"),
    **dict.fromkeys("“”", '"'),
    "…": "...",
    "≤": "<=",
    "≥": ">=",
    "±": "+-",
    "≈": "~",
    "→": "->",
    "\N{NO-BREAK SPACE}": " ",
}


def _replace(error: UnicodeError) -> tuple[str | bytes, int]:
    """A similar character or `?`; undecodable bytes of a file name stay as they are."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    first = error.object[error.start]
    if "\udc80" <= first <= "\udcff":
        return bytes([ord(first) - 0xDC00]), error.start + 1
    return _PLAIN.get(first, "?"), error.start + 1


REPLACING = "keyss.replacing"
codecs.register_error(REPLACING, _replace)
