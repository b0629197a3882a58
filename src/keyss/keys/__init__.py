"""Keys: from what a person types to derived keys, and authenticated encryption under them."""

from keyss.keys.derivation import (
    DerivedKey,
    KeyDerivation,
    generate_key,
    length_for,
    random_embeddings,
)
from keyss.keys.strength import key_strength_bits, weakness

__all__ = [
    "DerivedKey",
    "KeyDerivation",
    "generate_key",
    "key_strength_bits",
    "length_for",
    "random_embeddings",
    "weakness",
]
