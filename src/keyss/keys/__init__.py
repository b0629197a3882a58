"""Keys: from what a person types to derived keys, and authenticated encryption under them."""

from typing import TYPE_CHECKING

from keyss._lazy import lazily

if TYPE_CHECKING:
    from keyss.keys.derivation import (
        DerivedKey as DerivedKey,
        KeyDerivation as KeyDerivation,
        random_embeddings as random_embeddings,
    )
    from keyss.keys.generation import generate_key as generate_key, length_for as length_for
    from keyss.keys.master import MasterKey as MasterKey
    from keyss.keys.strength import key_strength_bits as key_strength_bits, weakness as weakness
else:
    __getattr__, __dir__, __all__ = lazily(
        __name__,
        {
            "keyss.keys.derivation": ["DerivedKey", "KeyDerivation", "random_embeddings"],
            "keyss.keys.generation": ["generate_key", "length_for"],
            "keyss.keys.master": ["MasterKey"],
            "keyss.keys.strength": ["key_strength_bits", "weakness"],
        },
    )
