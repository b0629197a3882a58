"""Strength of keys: a low estimate, and a warning for weak keys.

Argon2id costs an attacker about a tenth of a second of one core and 64 MiB for each guess: 80 bits are out of
reach, 40 bits are not. The estimate counts the guesses of somebody who knows how people choose keys; it
cannot know that a random-looking key is used elsewhere.
"""

from __future__ import annotations

import math
import re
import unicodedata
from itertools import pairwise

ENOUGH_BITS = 80.0
_LETTER_OF_WORD_BITS = 2.0  # Shannon (1951): 0.6 to 1.3 bits a letter of running English, more in short text
_PREDICTED_BITS = 1.0  # a character that repeats or continues a sequence
_CLASSES = ((r"[a-z]", 26), (r"[A-Z]", 26), (r"[0-9]", 10), (r"[ -/:-@\[-`{-~]", 33), (r"[^ -~]", 64))
_KEYBOARD = ("qwertyuiop", "asdfghjkl", "zxcvbnm", "qwertzuiop", "azertyuiop")


def key_strength_bits(key: str) -> float:
    """A conservative estimate of log2 of the guesses that find `key`; 16 generated characters give about 95.

    Each character counts as a random one of the classes in use, with three exceptions: 1 bit for a character
    that repeats or continues a sequence (aaa, 321, qwe), 2 bits for letters if most are in words, and a key
    that repeats a shorter one counts as that.
    """
    text = unicodedata.normalize("NFKC", key)
    text, repeats = _without_repetition(text)
    if not text:
        return 0.0
    class_bits = math.log2(sum(size for pattern, size in _CLASSES if re.search(pattern, text)))
    in_words = _mostly_words(text)
    bits = math.log2(repeats)
    for index, character in enumerate(text):
        if _is_predicted(text[max(0, index - 2) : index + 1]):
            bits += _PREDICTED_BITS
        elif in_words and character.isalpha():
            bits += _LETTER_OF_WORD_BITS
        else:
            bits += class_bits
    return bits


def weakness(key: str) -> str | None:
    """A warning for a weak key, None for a strong one."""
    bits = key_strength_bits(key)
    if bits >= ENOUGH_BITS:
        return None
    return (
        f"this key has about {bits:.0f} bits: below {ENOUGH_BITS:.0f} bits, whoever has the published file "
        "may guess it; `keyss keygen` makes keys of 95 bits"
    )


def _without_repetition(text: str) -> tuple[str, int]:
    """The shortest part that `text` repeats, and the number of repetitions."""
    for size in range(1, len(text) // 2 + 1):
        if len(text) % size == 0 and text[:size] * (len(text) // size) == text:
            return text[:size], len(text) // size
    return text, 1


def _mostly_words(text: str) -> bool:
    """True if three quarters of the letters are in apparent words.

    These are five letters in one case, or three letters without a neighbouring letter.
    """
    inside = letters = 0
    for run in re.findall(r"[^\W\d_]+", text):
        letters += len(run)
        if len(run) >= 3 and (run.islower() or run.isupper() or run.istitle()):
            inside += len(run)
        else:
            parts = re.split(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", run)
            inside += sum(
                len(part) for part in parts if len(part) >= 5 and (part[1:].islower() or part.isupper())
            )
    return inside > 0.75 * letters


def _is_predicted(three: str) -> bool:
    """True if the last of three characters continues the two before it."""
    if len(three) < 3:
        return False
    steps = {ord(b) - ord(a) for a, b in pairwise(three)}
    if steps in ({0}, {1}, {-1}):
        return True
    low = three.lower()
    return any(low in row or low[::-1] in row for row in _KEYBOARD)
