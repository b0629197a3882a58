"""Secrets in blocks of codes, which are never lost or reordered.

A secret is a header of two blocks, its data key and its parameters in *cells* with a tag, and the blocks of
its payload. A reader decrypts the cells of all blocks and keeps those with a valid tag. The parameters,
little-endian:

    version (1 byte), method (15, padded with zeros), bytes of the encrypted payload (4), bytes of a block (2)
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from keyss.channels.base import METHOD_BYTES, Payload, SaltedReader, pack_method, unpack_method
from keyss.channels.lsb.cells import TAG_BYTES, CellCipher
from keyss.channels.lsb.decoded import Decoded
from keyss.channels.lsb.fields import in_counted_order, last_bits, model_hash
from keyss.channels.lsb.usable import salt
from keyss.channels.lsb.wet_paper import block_ids, read_blocks
from keyss.channels.mixing import random_order, random_words
from keyss.core.arrays import Bytes
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.files.formats.common import Codes
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

DATA_KEY_BYTES = 16
LEAST_BYTES = 48  # minimum bytes of a block: a key cell, or the parameters
HEADER_BLOCKS = 2
MIN_BLOCKS = 4  # a salt, a header, and data
ASSOCIATED = b"keyss/v1/lsb"  # authenticated with a payload

_VERSION = 7
_PARAMETERS = struct.Struct(f"<B{METHOD_BYTES}sIH")
_PADDED = LEAST_BYTES - TAG_BYTES


def write_blocks(
    ids: Bytes, width: int, entropy: bytes, payloads: Sequence[tuple[DerivedKey, Payload]]
) -> Bytes:
    """[C, width] bytes of the blocks with `ids` [C, 16]: payloads, each with its key, and noise.

    `entropy`: 32 secret bytes. Raises UsageError for too large payloads. Each secret takes consecutive
    blocks, cyclically; all arrangements are equally likely.
    """
    table = np.empty((len(ids), width), np.uint8)
    fill(entropy, "lsb/noise", table)
    sizes = [-(-(compressed_size(payload.data) + OVERHEAD) // width) for _, payload in payloads]
    if (free := len(ids) - sum(sizes) - HEADER_BLOCKS * len(sizes)) < 0:
        raise UsageError(
            f"the secrets take {width * (len(ids) - free):,} bytes, and this cover has room for "
            f"{width * len(ids):,}"
        )
    first, *gaps = random_words(entropy, "lsb/gaps", len(payloads) + 1).tolist()
    gaps = sorted(gap % (free + 1) for gap in gaps)
    for index in random_order(entropy, "lsb/along", len(payloads)).tolist():
        key, payload = payloads[index]
        data_key, size = expand(entropy, f"lsb/data-key/{index}", DATA_KEY_BYTES), width * sizes[index]
        at = ((first + gaps.pop(0)) % len(ids) + np.arange(HEADER_BLOCKS + sizes[index])) % len(ids)
        parameters = _PARAMETERS.pack(_VERSION, pack_method(payload.method), size, width)
        cells = (_key_cipher(key), data_key), (_parameter_cipher(data_key), parameters)
        for row, (cipher, data) in zip(at[:HEADER_BLOCKS, None], cells, strict=True):
            own = np.frombuffer(data.ljust(cipher.size, b"\0"), np.uint8)[None]
            table[row, : cipher.cell_bytes] = cipher.encrypt(ids[row], own)
        encrypted = encrypt(expand(data_key, "payload-key", 32), payload.data, ASSOCIATED, size=size)
        table[at[HEADER_BLOCKS:]] = np.frombuffer(encrypted, np.uint8).reshape(-1, width)
        first += len(at)
    return table


@dataclass(frozen=True)
class BlockReader(SaltedReader):
    """Reads the blocks of a stego model."""

    ids: Bytes  # [C, 16]
    low: Bytes  # [C, B]
    salts: Sequence[bytes]

    @staticmethod
    def of(codes: Codes, decoded: Decoded | None = None) -> BlockReader | None:
        """None if `codes` have no capacity. `decoded`: the model that was decoded from them."""
        rows, ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        low = read_blocks(last_bits(fields))
        if len(low) < MIN_BLOCKS:
            return None
        ids = block_ids(len(low), model_hash(ordered, decoded[rows].model if decoded else None))
        return BlockReader(ids[1:], low[1:], [salt(ids[0], low[0, :LEAST_BYTES])])

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation under one salt."""
        _, keys = _key_cipher(key).decrypt(self.ids, self.low)
        data_key = keys[0].tobytes() if len(keys) else key.expand("lsb/none", DATA_KEY_BYTES)
        fits, found = _parameter_cipher(data_key).decrypt(self.ids, self.low)
        if not len(found):
            raise WrongKeyError()
        version, name, size, width = _PARAMETERS.unpack_from(found[0].tobytes())
        if version != _VERSION:
            raise InputError(f"hidden secret of version {version}; this program reads version {_VERSION}")
        count = -(-size // max(1, width))
        if count > len(self.low) or not 0 < width <= self.low.shape[1]:
            raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
        rows = (np.flatnonzero(fits)[0] + 1 + np.arange(count)) % len(self.low)
        encrypted = self.low[rows, :width].tobytes()[:size]
        data = decrypt(expand(data_key, "payload-key", 32), encrypted, ASSOCIATED)
        try:
            return Payload(unpack_method(name), data)
        except ValueError as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error


def _key_cipher(key: DerivedKey) -> CellCipher:
    return CellCipher(key.expand("lsb/key", 32), "key", DATA_KEY_BYTES)


def _parameter_cipher(data_key: bytes) -> CellCipher:
    return CellCipher(data_key, "parameters", _PADDED)
