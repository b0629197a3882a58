"""What somebody may have meant who misspelt a name."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches

LONGEST = 100  # characters of a word that is compared


def nearest(word: str, known: Collection[str]) -> str | None:
    """The one of `known` that is most like `word`, if any is like it; the same for the same names."""
    short = [each for each in sorted(known) if len(each) <= LONGEST]
    found = get_close_matches(word, short, n=1, cutoff=0.7) if len(word) <= LONGEST else []
    return found[0] if found else None


def did_you_mean(word: str, known: Collection[str]) -> str:
    """The end of a message about a misspelt name: what it may have meant, else all names that there are."""
    near = nearest(word, known)
    return f"did you mean {near}?" if near else f"expected one of {', '.join(sorted(known))}"
