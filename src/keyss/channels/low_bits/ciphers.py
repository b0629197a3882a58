"""The ciphers of every kind of cell, which reader and writer share."""

from __future__ import annotations

from keyss.channels.low_bits.cells import CellCipher
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, Carriers
from keyss.channels.low_bits.spread import NUMBER_BYTES, TAG_BYTES, chunk_bytes
from keyss.keys.derivation import DerivedKey, expand

ASSOCIATED = b"keyss/v1/low-bits"  # authenticated with a payload


def key_cipher(key: DerivedKey) -> CellCipher:
    """Of cells that hold a data key."""
    return CellCipher(key.expand("low-bits/key", 32), "key", DATA_KEY_BYTES)


def parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    """Of parts of the parameters, each with its number."""
    return CellCipher(data_key, "parameters", 1 + Carriers(0, width).part_bytes)


def chunk_cipher(data_key: bytes, width: int) -> CellCipher:
    """Of chunks of a payload, each with its number."""
    return CellCipher(data_key, "chunk", NUMBER_BYTES + chunk_bytes(width), TAG_BYTES)


def payload_key(data_key: bytes) -> bytes:
    """What a payload is encrypted under, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)
