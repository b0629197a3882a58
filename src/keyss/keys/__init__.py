"""Keys: from what a person types to derived keys, and authenticated encryption under them.

All of it is loaded at first use (PEP 562): a new key is there without torch, which takes seconds.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from keyss.keys.derivation import DerivedKey, KeyDerivation, random_embeddings
    from keyss.keys.generation import generate_key, length_for
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

_HOMES = {
    "DerivedKey": "derivation",
    "KeyDerivation": "derivation",
    "generate_key": "generation",
    "key_strength_bits": "strength",
    "length_for": "generation",
    "random_embeddings": "derivation",
    "weakness": "strength",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'keyss.keys' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"keyss.keys.{_HOMES[name]}"), name)
    return value
