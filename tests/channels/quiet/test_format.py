"""A second reader, written from docs/byte-layout.md with other libraries only, opens what keyss wrote."""

from __future__ import annotations

import hashlib
import json
import struct
from collections import Counter
from itertools import combinations
from pathlib import Path

import numpy as np
import plyfile
import pytest
from argon2.low_level import Type, hash_secret_raw
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import CBC, ECB
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
EXPECTED = json.loads((FOLDER / "carried.json").read_text())
WIDTH = 75  # bytes of a Gaussian's low bits at SH degree 3


def _hkdf(secret: bytes, label: str, length: int = 32) -> bytes:
    return HKDFExpand(SHA256(), length, f"keyss/v1/{label}".encode()).derive(secret)


def _aes(key: bytes, block: bytes) -> bytes:
    return Cipher(AES(key), ECB()).encryptor().update(block)


def _decrypted(secret: bytes, label: str, carrier_id: bytes, cell: bytes) -> bytes | None:
    tag, hidden = cell[:4], cell[4:]
    nonce = bytes(a ^ b for a, b in zip(carrier_id, tag.ljust(16, b"\0"), strict=True))
    seed = _aes(_hkdf(secret, f"{label}/seed"), nonce)
    blocks = range(-(-len(hidden) // 16))
    stream = b"".join(
        _aes(_hkdf(secret, f"{label}/stream"), seed[:-1] + bytes([seed[-1] ^ i])) for i in blocks
    )
    data = bytes(a ^ b for a, b in zip(hidden, stream, strict=False))
    message = carrier_id + data.ljust(16 * len(blocks), b"\0")
    mac = Cipher(AES(_hkdf(secret, f"{label}/tag")), CBC(bytes(16))).encryptor().update(message)[-16:]
    return data if mac[:4] == tag else None


def _gaussians() -> list[tuple[tuple[bool, int], bytes, bytes]]:
    """Place in the order of salts, carrier_id and low bits of each."""
    vertices = plyfile.PlyData.read(FOLDER / "carried.ply")["vertex"]
    harmonics = [f"f_rest_{15 * colour + k}" for k in range(15) for colour in range(3)]
    names = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity", *harmonics]
    found, lengths = [], []
    for index in range(vertices.count):
        words = [int(np.float32(vertices[name][index]).view(np.uint32)) for name in names]
        masks = [0x1FE] * 8 + [0x1FFE] * 45
        middle = [word & ~0x1FF | 0x100 for word in words[3:7]]
        lengths.append(float(np.linalg.norm(np.array(middle, np.uint32).view(np.float32).astype(float))))
        kept = [int(np.float32(vertices[axis][index]).view(np.uint32)) for axis in "xyz"]
        kept += [word & ~mask for word, mask in zip(words, masks, strict=True)]
        public = struct.pack(f"<{len(kept)}I", *kept)
        carrier_id = hashlib.blake2b(public, digest_size=16, person=b"keyss/identity").digest()
        low = [(word & mask) >> 1 for word, mask in zip(words, masks, strict=True)]
        data = bytes(low[:8])
        for a, b in zip(low[8::2], [*low[9::2], 0], strict=False):
            data += bytes([a >> 4, (a & 15) << 4 | b >> 8, b & 255])
        found.append(((_is_doubtful(words, masks, lengths[-1]), -_least(words)), carrier_id, data[:WIDTH]))
    assert abs(np.median(lengths) - 1) > 1e-4  # quaternions are in use
    return found


def _least(words: list[int]) -> int:
    return min(word >> 23 & 255 for word in words[8:])


def _is_doubtful(words: list[int], masks: list[int], length: float) -> bool:
    if abs(length - 1) < 1e-4:
        return True
    if any(
        word >> 23 & 255 == 0 or word & 0x7FFFFE & ~mask == 0 for word, mask in zip(words, masks, strict=True)
    ):
        return True
    high = [(word & 0x7FFFFFFF) >> mask.bit_length() for word, mask in zip(words, masks, strict=True)]
    together = [high[:3], high[3:7], *(high[at : at + 3] for at in range(8, 53, 3))]
    return any(abs(a - b) <= 1 for values in together for a, b in combinations(values, 2))


def test_a_reader_written_from_the_description_opens_the_carried_model() -> None:
    ordered = sorted(_gaussians())
    gaussians = [(carrier_id, low) for _, carrier_id, low in ordered]
    salts = [hashlib.sha256(b"keyss/v2/salt" + b"".join(each)).digest()[:16] for each in gaussians[:12]]
    salt = salts[0]
    master = hash_secret_raw(EXPECTED["key"].encode(), salt, 3, 65_536, 4, 32, Type.ID)
    key_secret = _hkdf(master, "quiet/key")
    data_keys = [_decrypted(key_secret, "key", carrier_id, low[:20]) for carrier_id, low in gaussians]
    ((data_key, times),) = Counter(filter(None, data_keys)).most_common(1)
    assert times == 12

    parts = _numbered(data_key, "parameters", gaussians, WIDTH - 4, 1)
    packed = b"".join(part for _, part in sorted(parts.items()))
    version, method, size = struct.unpack_from("<B15sI", packed)
    assert (version, method.rstrip(b"\0")) == (6, b"carry")
    carriers, codewords, n, k = struct.unpack_from("<IIHH", packed, 20)
    assert carriers == len(gaussians)
    sketch, place_key = int.from_bytes(packed[32:64], "little"), _hkdf(data_key, "sketch")
    places = {int.from_bytes(_aes(place_key, own)[:4], "little") % carriers for own, _ in gaussians}
    assert {place for place in places if place < 256} == {bit for bit in range(256) if sketch >> bit & 1}

    width = (WIDTH - 7) // 2 * 2
    chunks = _numbered(data_key, "chunk", gaussians, 3 + width, 3)
    assert chunks.keys() == set(range(codewords * n))
    encrypted = b"".join(chunks[number] for number in range(codewords * k))[:size]
    payload_key = _hkdf(_hkdf(data_key, "payload-key"), "payload")
    plain = ChaCha20Poly1305(payload_key).decrypt(bytes(12), encrypted, b"keyss/v1/quiet")
    (length,) = struct.unpack_from("<I", plain)
    payload = plain[4 : 4 + length]
    assert not any(plain[4 + length :])
    assert payload.hex() == EXPECTED["payload"]
    assert struct.unpack_from("<I", payload) == (EXPECTED["count"],)


def _numbered(
    data_key: bytes, label: str, gaussians: list[tuple[bytes, bytes]], size: int, number_bytes: int
) -> dict[int, bytes]:
    """By number, the data of all cells of a label that hold `size` bytes, of which the first are a number."""
    cells = (_decrypted(data_key, label, carrier_id, low[: 4 + size]) for carrier_id, low in gaussians)
    return {
        int.from_bytes(data[:number_bytes], "little"): data[number_bytes:]
        for data in cells
        if data is not None
    }
