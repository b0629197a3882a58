"""Strength of keys: how many guesses find one, and a warning for weak keys.

zxcvbn counts the guesses of somebody who knows how people choose passwords (Wheeler 2016): words, names,
dates, keyboards, repetitions. It cannot know that a key is used elsewhere. Argon2id costs 0.1 s of a core and
64 MiB for each guess: ENOUGH_GUESSES take three hundred thousand years of one core.
"""

from __future__ import annotations

import math

from keyss.keys.key_file import normalized_key

ENOUGH_GUESSES = 1e14
_MAX_LENGTH = 100  # characters that are looked at, since the time grows faster than their number


def key_guesses(key: str) -> float:
    """The number of guesses that find `key`, as it is used: see `normalized_key`, which raises UsageError.

    A random character counts as ten guesses, letters too: 10^16 for 16 generated ones.
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
