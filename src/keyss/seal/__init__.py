"""Keys, and what they seal: payloads encrypted in a file of their own or in a model's low bits."""

from keyss.seal.container import embed, extract
from keyss.seal.keys import (
    EMBEDDING_SIZE,
    DerivedKey,
    KeyDerivation,
    generate_key,
    length_for,
    random_embeddings,
)
from keyss.seal.plan import capacity
from keyss.seal.sidecar import seal_sidecar, unseal_sidecar
from keyss.seal.strength import key_strength_bits, weakness

__all__ = [
    "EMBEDDING_SIZE",
    "DerivedKey",
    "KeyDerivation",
    "capacity",
    "embed",
    "extract",
    "generate_key",
    "key_strength_bits",
    "length_for",
    "random_embeddings",
    "seal_sidecar",
    "unseal_sidecar",
    "weakness",
]
