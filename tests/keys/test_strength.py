"""The estimated strength of keys is low for weak keys and sufficient for generated ones."""

from __future__ import annotations

import statistics

import pytest

from keyss.keys import ENOUGH_BITS, generate_key, key_strength_bits, length_for, weakness


def test_generated_keys_have_their_full_strength() -> None:
    bits = [key_strength_bits(generate_key()) for _ in range(300)]
    assert statistics.median(bits) == pytest.approx(95, abs=1)
    assert sum(value < ENOUGH_BITS for value in bits) < 10
    assert key_strength_bits(generate_key(length_for(128))) > ENOUGH_BITS
    assert length_for(95) == 16


@pytest.mark.parametrize(
    ("key", "most"),
    [
        ("", 0),
        ("password", 20),
        ("Password123", 40),
        ("a" * 100, 15),
        ("abcabc" * 10, 20),
        ("123456789012345678901234567890", 40),
        ("qwertyuiop asdfghjkl", 60),
        ("correct horse battery staple", 70),
        ("жизнь-прекрасна", 60),
        ("kS9#", 30),
    ],
)
def test_keys_that_people_choose_are_weak(key: str, most: float) -> None:
    assert key_strength_bits(key) <= most
    assert weakness(key) is not None
    assert key not in (weakness(key) or "") or len(key) < 3


def test_longer_is_never_weaker_for_random_keys() -> None:
    key = "q7Rv2LxT9bWm4KzD"
    bits = [key_strength_bits(key[:size]) for size in range(1, len(key) + 1)]
    assert bits == sorted(bits)
    assert weakness(key) is None
