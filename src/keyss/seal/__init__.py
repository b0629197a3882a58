"""Keys: derivation from what a person types."""

from keyss.seal.keys import (
    EMBEDDING_SIZE,
    DerivedKey,
    KeyDerivation,
    generate_key,
    random_embeddings,
)

__all__ = ["EMBEDDING_SIZE", "DerivedKey", "KeyDerivation", "generate_key", "random_embeddings"]
