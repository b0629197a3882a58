"""Suggestions for misspelt names."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches

MAX_LENGTH = 100  # characters of a word that is compared


def nearest(word: str, known: Collection[str]) -> str | None:
    """The most similar of the `known` names, None if none is similar."""
    short = [name for name in sorted(known) if len(name) <= MAX_LENGTH]
    matches = get_close_matches(word, short, n=1, cutoff=0.7) if len(word) <= MAX_LENGTH else []
    return matches[0] if matches else None


def did_you_mean(word: str, known: Collection[str]) -> str:
    """The end of a message about a misspelt name: a suggestion, else all `known` names."""
    near = nearest(word, known)
    return f"did you mean {near}?" if near else f"expected one of {', '.join(sorted(known))}"
