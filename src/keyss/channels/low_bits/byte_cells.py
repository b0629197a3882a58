"""One Gaussian's low bits as a cell: a number and some data, recognisable with the key and noise without.

    tag (6 bytes), then encrypted: number (3 bytes), data

A synthetic IV (as in RFC 5297): the tag is a keyed BLAKE2b (RFC 7693) of the Gaussian's identity and the
plain bytes, and the key stream a keyed BLAKE2b of identity and tag. So the same key over the same Gaussian
may carry different bytes, as it does when a model is embedded into twice, without a key stream being used
twice; nothing but a repetition of the very same bytes can be noticed. A reader opens every Gaussian of a
model and keeps those whose tag fits; by chance one fits in 2^48.
"""

from __future__ import annotations

import hmac
from collections.abc import Iterable, Iterator
from hashlib import blake2b

from keyss.keys.derivation import expand

TAG_BYTES = 6
NUMBER_BYTES = 3
OVERHEAD = TAG_BYTES + NUMBER_BYTES
_BLOCK = 64


class CellCipher:
    """Opens and closes the cells of one use of a 32-byte `secret`."""

    def __init__(self, secret: bytes, label: str) -> None:
        self._tag_key = expand(secret, f"{label}/tag", 32)
        self._stream_key = expand(secret, f"{label}/stream", 32)

    def close(self, identity: bytes, number: int, data: bytes) -> bytes:
        """The cell of `OVERHEAD + len(data)` bytes; 0 <= number < 2^24."""
        plain = number.to_bytes(NUMBER_BYTES, "little") + data
        tag = self._tag(identity, plain)
        return tag + _xor(plain, self._stream(identity + tag, len(plain)))

    def open(self, identity: bytes, cell: bytes) -> tuple[int, bytes] | None:
        """The number and the data, None for a cell that is not of this secret."""
        tag, hidden = cell[:TAG_BYTES], cell[TAG_BYTES:]
        plain = _xor(hidden, self._stream(identity + tag, len(hidden)))
        if not hmac.compare_digest(tag, self._tag(identity, plain)):
            return None
        return int.from_bytes(plain[:NUMBER_BYTES], "little"), plain[NUMBER_BYTES:]

    def open_all(self, identities: Iterable[bytes], cells: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
        """What the cells of this secret hold, in the order given."""
        for identity, cell in zip(identities, cells, strict=True):
            opened = self.open(identity, cell)
            if opened is not None:
                yield opened

    def _tag(self, identity: bytes, plain: bytes) -> bytes:
        return blake2b(identity + plain, key=self._tag_key, digest_size=TAG_BYTES).digest()

    def _stream(self, nonce: bytes, length: int) -> bytes:
        stream = blake2b(nonce + b"\0", key=self._stream_key).digest()
        for block in range(1, -(-length // _BLOCK)):
            stream += blake2b(nonce + bytes([block]), key=self._stream_key).digest()
        return stream[:length]


def _xor(a: bytes, b: bytes) -> bytes:
    return (int.from_bytes(a, "little") ^ int.from_bytes(b, "little")).to_bytes(len(a), "little")
