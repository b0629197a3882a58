"""Strength of chosen and generated keys."""

from __future__ import annotations

import random

import pytest

from keyss.core import KeyssWarning, UsageError
from keyss.keys import ALPHABET, key_guesses, length_for, normalized_key, weakness


def test_generated_keys_are_strong() -> None:
    """Also if they contain a word or a date by chance."""
    rng = random.Random(0)
    keys = ["".join(rng.choices(ALPHABET, k=length_for(95))) for _ in range(100)]
    assert length_for(95) == 16
    assert [key for key in keys if weakness(key) is not None] == []


@pytest.mark.parametrize(
    ("key", "most"),
    [
        ("password", 1e1),
        ("Password123", 1e4),
        ("a" * 4000, 1e4),
        ("abcabc" * 10, 1e4),
        ("123456789012345678901234567890", 1e4),
        ("qwertyuiop asdfghjkl", 1e10),
        ("27.11.1984", 1e6),
        ("kS9#", 1e5),
    ],
)
def test_weak_keys(key: str, most: float) -> None:
    assert key_guesses(key) <= most
    message = weakness(key)
    assert key not in message


def test_normalised_before_rating() -> None:
    with pytest.warns(KeyssWarning, match="white space"):
        assert key_guesses("abc" + "\t" * 80) == key_guesses("abc")
    assert key_guesses("\ufb01ne") == key_guesses("fine")  # a ligature


def test_length_is_checked_before_normalising() -> None:
    """Normalising so many combining characters takes minutes."""
    with pytest.raises(UsageError, match="longer than 4096 bytes"):
        normalized_key("a" + "\u0301\u0316" * 300_000)
