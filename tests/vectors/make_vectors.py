"""Write the known answers of this folder again, after a change of format that is meant.

    python tests/vectors/make_vectors.py

`carried.json` is not written here: what old files revealed, new ones must reveal too.
"""

from __future__ import annotations

import json
import sys
import unicodedata
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parent))

from argon2.low_level import Type, hash_secret_raw  # noqa: E402
from cryptography.hazmat.primitives.ciphers import Cipher  # noqa: E402
from cryptography.hazmat.primitives.ciphers.algorithms import AES  # noqa: E402
from cryptography.hazmat.primitives.ciphers.modes import CBC, ECB  # noqa: E402
from cryptography.hazmat.primitives.hashes import SHA256  # noqa: E402
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand  # noqa: E402

from channels.low_bits.trained_like import trained_like  # noqa: E402
from keyss.channels.base import Payload  # noqa: E402
from keyss.channels.low_bits import LOW_BITS  # noqa: E402
from keyss.files.ply import write_ply  # noqa: E402
from keyss.methods.learned.payload import pack_secret  # noqa: E402
from methods.carry.carried import embed  # noqa: E402
from methods.learned.hiding import some_secret  # noqa: E402


def cell() -> dict[str, object]:
    """A cell as docs/format.md describes it, by the library's own modes of operation."""
    secret, identity = bytes(range(32)), bytes(range(16))
    label, data, slot, tag_bytes = "chunk", b"\x02\x01\x00chunk", 1, 6

    def key(use: str) -> bytes:
        return HKDFExpand(SHA256(), 32, f"keyss/v1/{label}/{use}".encode()).derive(secret)

    def aes(use: str, block: bytes) -> bytes:
        return Cipher(AES(key(use)), ECB()).encryptor().update(block)

    message = identity + (bytes([slot]) + data).ljust(16, b"\0")
    tag = Cipher(AES(key("tag")), CBC(bytes(16))).encryptor().update(message)[-16:][:tag_bytes]
    nonce = bytes(a ^ b for a, b in zip(identity, (tag + bytes([slot])).ljust(16, b"\0"), strict=True))
    stream = aes("stream", aes("seed", nonce))
    return {
        "secret": secret.hex(),
        "label": label,
        "identity": identity.hex(),
        "slot": slot,
        "tag_bytes": tag_bytes,
        "data": data.hex(),
        "cell": (tag + bytes(a ^ b for a, b in zip(data, stream, strict=False))).hex(),
    }


def derivation() -> dict[str, object]:
    """What keys become, by the libraries themselves."""
    vectors = json.loads((FOLDER / "derivation.json").read_text())
    for vector in vectors["valid"]:
        key, salt = unicodedata.normalize("NFKC", vector["key"]).encode(), bytes.fromhex(vector["salt"])
        costs = (vector["time_cost"], vector["memory_kib"], vector["parallelism"])
        master = hash_secret_raw(key, salt, *costs, 32, Type.ID)
        for label in ("writer", "low-bits/key"):
            expand = HKDFExpand(SHA256(), 32, f"keyss/v1/{label}".encode())
            vector[label] = expand.derive(master).hex()
    return vectors


def main() -> None:
    (FOLDER / "derivation.json").write_text(json.dumps(derivation(), indent=1) + "\n")
    sealing = json.loads((FOLDER / "sealing.json").read_text())
    sealing["cell"] = cell()
    (FOLDER / "sealing.json").write_text(json.dumps(sealing, indent=1) + "\n")
    key = json.loads((FOLDER / "carried.json").read_text())["key"]
    secret = trained_like(8, 1, 1)
    secret.means[0, 0] = 1e6  # an outlier
    stego = embed(trained_like(400), [(key, secret)], entropy=bytes(32))
    write_ply(FOLDER / "carried.ply", stego)
    cover = trained_like(1600)
    learned = Payload("learned", pack_secret(some_secret(cover)))
    stego = LOW_BITS.prepare(cover).embed([(key, learned)], entropy=bytes(32))
    write_ply(FOLDER / "learned.ply", stego)
    write_ply(FOLDER / "learned-secret.ply", some_secret(cover).reveal(cover))


if __name__ == "__main__":
    main()
