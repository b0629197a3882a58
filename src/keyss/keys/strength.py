"""Strength of keys: the number of guesses that find one, and a warning for weak keys.

zxcvbn (Wheeler 2016) estimates guesses from patterns in passwords that people choose: words, names, dates,
keyboards, repetitions. It cannot detect a key reused from elsewhere. Argon2id costs 0.1 s of a core and
64 MiB per guess: ENOUGH_GUESSES take three hundred thousand years of one core.
"""

from __future__ import annotations

import math

from keyss.keys.key_file import normalized_key

ENOUGH_GUESSES = 1e14
_MAX_LENGTH = 100  # characters; zxcvbn takes superlinear time


def key_guesses(key: str) -> float:
    """The number of guesses that find `key` after `normalized_key`. Raises UsageError for an invalid key.

    zxcvbn counts a random character, even a letter, as ten guesses: 10^16 for a generated key of 16.
    """
    from zxcvbn import zxcvbn  # slow to import

    return float(zxcvbn(normalized_key(key)[:_MAX_LENGTH], max_length=_MAX_LENGTH)["guesses"])


def weakness(key: str) -> str | None:
    """A warning for a weak key, None for a strong one."""
    guesses = key_guesses(key)
    if guesses >= ENOUGH_GUESSES:
        return None
    return (
        f"about 10^{math.log10(guesses):.0f} guesses find this key, and whoever has the published file can "
        "make them; `keyss keygen` makes keys that nobody guesses"
    )
