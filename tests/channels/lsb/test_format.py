"""A second reader, written from docs/byte-layout.md with other libraries only, opens what keyss wrote."""

from __future__ import annotations

import hashlib
import json
import struct
from collections import Counter
from pathlib import Path

import numpy as np
import plyfile
import pytest
from argon2.low_level import Type, hash_secret_raw
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.ciphers.algorithms import AES, ChaCha20
from cryptography.hazmat.primitives.ciphers.modes import ECB
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[2] / "vectors"
EXPECTED = json.loads((FOLDER / "carried.json").read_text())
Row = tuple[bytes, bytes]  # ID and low bits


def _hkdf(secret: bytes, label: str, length: int = 32) -> bytes:
    return HKDFExpand(SHA256(), length, f"keyss/v1/{label}".encode()).derive(secret)


def _aes(key: bytes, block: bytes) -> bytes:
    return Cipher(AES(key), ECB()).encryptor().update(block)


def _function(secret: bytes, label: str, carrier_id: bytes, size: int = 16) -> bytes:
    key = _hkdf(secret, f"lsb/{label}")
    blocks = (carrier_id[:15] + bytes([carrier_id[15] ^ i]) for i in range(-(-size // 16)))
    return b"".join(_aes(key, block) for block in blocks)[:size]


def _xor(a: bytes, b: bytes) -> bytes:
    return bytes(x ^ y for x, y in zip(a, b, strict=True))


def _message(secret: bytes, label: str, size: int, width: int, copies: int, rows: list[Row]) -> bytes:
    count = -(-size // width)
    values = sorted((_function(secret, f"{label}/place", own)[:12], own, low) for own, low in rows)
    places: dict[int, list[bytes]] = {fragment: [] for fragment in range(count)}
    for value, own, low in values[: 8 * copies * count]:
        found = places[int.from_bytes(value[8:12], "little") % count]
        found.append(_xor(low[:width], _function(secret, f"{label}/pad", own, width)))
    return b"".join(Counter(found).most_common(1)[0][0] for found in places.values())[:size]


def _packed(words: list[int], depth: int) -> bytes:
    bits = "".join(f"{word >> 1 & (1 << depth) - 1:0{depth}b}" for word in words)
    return bytes(int(bits[8 * i : 8 * i + 8], 2) for i in range(len(bits) // 8))


def _gaussians() -> list[tuple[int, bytes, list[int]]]:
    """Place in the order of salts, ID and fields of each."""
    vertices = plyfile.PlyData.read(FOLDER / "carried.ply")["vertex"]
    harmonics = [f"f_rest_{15 * colour + k}" for k in range(15) for colour in range(3)]
    names = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity", *harmonics]
    found, lengths = [], []
    for index in range(vertices.count):
        words = [int(np.float32(vertices[name][index]).view(np.uint32)) for name in names]
        middle = [word & ~0x1FF | 0x100 for word in words[3:7]]
        lengths.append(float(np.linalg.norm(np.array(middle, np.uint32).view(np.float32).astype(float))))
        kept = [int(np.float32(vertices[axis][index]).view(np.uint32)) for axis in "xyz"]
        kept += [word & ~0x1FE for word in words]
        public = struct.pack(f"<{len(kept)}I", *kept)
        carrier_id = hashlib.blake2b(public, digest_size=16, person=b"keyss/identity").digest()
        small = [118 - (word >> 23 & 255) for word in words if word % 2 == 0]
        found.append((255 if _moved_from_zero(words) else max([0, *small]), carrier_id, words))
    assert abs(np.median(lengths) - 1) > 1e-4  # quaternions are in use
    return found


def _moved_from_zero(words: list[int]) -> bool:
    groups = [[*words[:3], words[7]], words[3:7], *(words[8 + colour :: 3] for colour in range(3))]
    for group in groups:
        middle = np.array([word & 0x7FFFFFE0 | 0x10 for word in group], np.uint32).view(np.float32)
        spans = [2.0 ** ((word >> 23 & 255) - 127 - 18) for word in group]
        for one, size in enumerate(middle.astype(float)):
            near = [
                abs(size - other) <= max(spans[one], span) for other, span in zip(middle, spans, strict=True)
            ]
            if sum(near) >= 3:
                return True
    return False


def test_a_reader_written_from_the_description_opens_the_carried_model() -> None:
    ordered = sorted(_gaussians())
    least = [(own, _packed(words, 4)) for _, own, words in ordered]
    assert {len(low) for _, low in least} == {26}
    salts = [hashlib.sha256(b"keyss/v1/salt" + b"".join(each)).digest()[:16] for each in least[:4]]
    for salt in salts:
        master = hash_secret_raw(EXPECTED["key"].encode(), salt, 3, 65_536, 4, 32, Type.ID)
        data_key = _message(_hkdf(master, "channel/key"), "key", 16, 16, 12, least)
        packed = _message(data_key, "parameters", 18, 26, 32, least)
        if packed[:8] == _hkdf(data_key, "check", 8):
            break
    version, depth, codewords, n, k = struct.unpack_from("<BBIHH", packed, 8)
    assert version == 1
    assert codewords <= 32  # one group

    shards: dict[int, set[bytes]] = {}
    for _, own, words in ordered:
        value, low = _function(data_key, "shard/place", own), _packed(words, depth)
        number, width = int.from_bytes(_xor(low[1:3], value[2:4]), "little"), (len(low) - 3) // 2 * 2
        if low[0] == value[0] and number < codewords * n:
            data = _xor(low[3 : 3 + width], _function(data_key, "shard/pad", own, width))
            shards.setdefault(number, set()).add(data)
    assert shards.keys() == set(range(codewords * n))
    assert all(len(shards[number]) == 1 for number in range(codewords * k))  # no false ones among the data
    sealed = b"".join(min(shards[number]) for number in range(codewords * k))
    mask = Cipher(ChaCha20(_hkdf(data_key, "record"), bytes(16)), None).encryptor().update(bytes(36))
    record = _xor(sealed[:36], mask)
    carriers, bloom = struct.unpack_from("<I", record)[0], int.from_bytes(record[4:], "little")
    assert carriers == len(ordered)
    place_key = _hkdf(data_key, "bloom")
    places = {int.from_bytes(_aes(place_key, own)[:4], "little") % carriers for own, _ in least}
    assert {place for place in places if place < 256} == {bit for bit in range(256) if bloom >> bit & 1}
    payload_key = _hkdf(_hkdf(data_key, "payload-key"), "payload")
    plain = ChaCha20Poly1305(payload_key).decrypt(bytes(12), sealed[36:], b"keyss/v1/payload" + record)
    (length,) = struct.unpack_from("<I", plain)
    method, _, payload = plain[4 : 4 + length].partition(b"\0")
    assert method == b"carry"
    assert not any(plain[4 + length :])
    assert payload.hex() == EXPECTED["payload"]
    assert struct.unpack_from("<I", payload) == (EXPECTED["count"],)
