"""Payloads in the low bits of a model, to be found again with nothing but the model and a key.

There is no header to be recognised. The Argon2id salt is a hash of the Gaussian with the smallest identity
(see `low_bits`), as good as random and different for every model. Because that Gaussian may be removed, the
payload's data key lies there for each of the 12 smallest identities, in *header cells* closed under what
the secret's key becomes with that salt. The *data cells* are closed under the data key, and the payload in
them is sealed under it once more. A reader derives one salt and passes twice over all cells; one whose key
opens no header cell passes the second time with a data key that fits nothing. So a right and a wrong key do
the same work up to the decryption of the payload.

Everything that is random for the writer is derived from the masters of all keys, the payloads and the model
as it was *before* (thus a run can be repeated to the byte). Nobody else knows it: the low bits of the model
before are overwritten, and they are most of the entropy. In particular the holder of one key cannot compute
what a model with only that one secret would look like, and compare. All usable cells get new low bits: the
secrets' cells, an equal share for each, and noise in the rest, so that cells of other secrets and cells of
none cannot be told apart even where trained low bits are not perfectly uniform.

No key stream is used twice. Data cells: the data key depends on key, model and payload. Header cells, whose
key depends on key and salt only: their key stream depends on the content (see `cells`).
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt

from keyss.channels.low_bits import reed_solomon
from keyss.channels.low_bits.bits import (
    bytes_per_gaussian,
    check_natural,
    identities,
    is_random,
    read_low_bits,
    write_low_bits,
)
from keyss.channels.low_bits.byte_cells import CellCipher
from keyss.channels.low_bits.byte_plan import (
    COPIES,
    SALTS,
    Plan,
    chunk_bytes,
    header_parts,
    plan,
    shares,
    too_small,
)
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.sealed import DATA_KEY_BYTES, compressed_size, seal, sealed_size, unseal

_HEADER = struct.Struct("<32sI3sBB")
_ASSOCIATED = b"keyss/v1/low-bits"

Rows = npt.NDArray[np.int64]


def embed(stego: Gaussians, secrets: Sequence[tuple[str, bytes]]) -> Gaussians:
    """`stego` with one (key, payload) per secret in its low bits; nothing else of it changes.

    Takes 1.6 s per secret for key derivation. Raises UsageError for keys that are equal and for a model too
    small, and InputError for one whose low bits are not random (it came through a quantised format).
    """
    if not secrets:
        raise UsageError("expected at least one secret")
    names = identities(stego)
    derivations = [derivation_of(identity) for identity in smallest(names)]
    return embed_derived(
        stego,
        [([DerivedKey(key, each) for each in derivations], payload) for key, payload in secrets],
    )


def embed_derived(stego: Gaussians, secrets: Sequence[tuple[Sequence[DerivedKey], bytes]]) -> Gaussians:
    """`embed` after key derivation: of every secret its key under each of the salts, and the payload."""
    if any(a[0].equals(b[0]) for (a, _), (b, _) in combinations(secrets, 2)):
        raise UsageError("two secrets have the same key: each needs its own")
    degree, count = stego.sh_degree, len(secrets)
    usable = is_random(stego)
    if usable.mean() < 0.5:
        raise InputError(
            f"only {usable.mean():.0%} of the Gaussians have random low bits, the others hold short or "
            "repeated values: the model was quantised or hardly trained; --sidecar needs no low bits"
        )
    check_natural(stego, usable)
    # Each secret is spread as its own size asks: what its key shows must not depend on the others' sizes.
    sizes = [sealed_size(compressed_size(payload)) for _, payload in secrets]
    spreads = []
    for size in sizes:
        spread = plan(int(usable.sum()), count, degree, size)
        if spread is None:
            raise UsageError(too_small(len(stego), float(usable.mean()), size, count, degree))
        spreads.append(spread)

    names = identities(stego)
    before = hashlib.sha256(read_low_bits(stego).tobytes() + b"".join(names)).digest()
    parts = [before]
    for keys, payload in secrets:
        parts += [keys[0].expand("cells/writer", 32), hashlib.sha256(payload).digest()]
    writer = hashlib.sha256(b"".join(parts)).digest()

    rows = np.flatnonzero(usable)
    order = np.frombuffer(stream(writer, "cells/order", 8 * len(rows)), "<u8")
    rows = rows[np.argsort(order, kind="stable")]
    width = bytes_per_gaussian(degree)
    noise = stream(writer, "cells/noise", len(rows) * width)
    cells = [noise[start : start + width] for start in range(0, len(noise), width)]
    share = len(rows) // shares(count)
    for index, (keys, payload) in enumerate(secrets):
        data_key = expand(writer, f"cells/data-key/{index}", DATA_KEY_BYTES)
        own = [names[row] for row in rows[index * share : (index + 1) * share]]
        size, spread = sizes[index], spreads[index]
        header = _pack_header(data_key, size, spread)
        closed = _close_header(header, keys, own, degree)
        sealed = seal(data_key, payload, _ASSOCIATED, size=size)
        closed += _close_data(sealed, data_key, spread, own[len(closed) :])
        cells[index * share : (index + 1) * share] = closed
    table = np.frombuffer(b"".join(cells), np.uint8).reshape(len(rows), width)
    return write_low_bits(stego, rows, table)


def extract(stego: Gaussians, key: str) -> bytes:
    """The payload that `key` opens in `stego`.

    Raises WrongKeyError when it opens nothing, which is so for ordinary models too, and InputError when the
    payload is there but too much of it was removed or changed.
    """
    names = identities(stego)
    return extract_derived(stego, key_for(names, key), names)


def key_for(names: Iterable[bytes], key: str) -> DerivedKey:
    """What `key` becomes for a model of these identities; takes about 0.1 s."""
    return DerivedKey(key, derivation_of(smallest(names)[0]))


def extract_derived(stego: Gaussians, key: DerivedKey, names: Sequence[bytes] | None = None) -> bytes:
    """`extract` after key derivation; `names`: the identities, if they are known already."""
    chunk = chunk_bytes(stego.sh_degree)
    if chunk == 0:
        raise WrongKeyError("this key opens nothing here")
    names = identities(stego) if names is None else names
    table, width = read_low_bits(stego).tobytes(), bytes_per_gaussian(stego.sh_degree)
    cells = [table[start : start + width] for start in range(0, len(table), width)]
    found = dict(_header_cipher(key).open_all(names, cells))
    parts = range(header_parts(stego.sh_degree))
    if found and any(part not in found for part in parts):
        raise InputError("the key is right, but too much of the model was removed")
    if found:
        data_key, size, spread = _unpack_header(b"".join(found[part] for part in parts), chunk)
    else:
        data_key = key.expand("cells/none", DATA_KEY_BYTES)
    chunks = list(_data_cipher(data_key).open_all(names, cells))
    if not found:
        raise WrongKeyError("this key opens nothing here")
    return unseal(data_key, _join(chunks, spread, size), _ASSOCIATED)


def smallest(names: Iterable[bytes]) -> list[bytes]:
    """The identities that may serve as salt, in ascending order."""
    return sorted(set(names))[:SALTS]


def derivation_of(identity: bytes) -> KeyDerivation:
    """The costs are fixed: there is nowhere to state others before a key is derived."""
    return KeyDerivation(salt=hashlib.sha256(b"keyss/v1/salt" + identity).digest()[:SALT_BYTES])


def _header_cipher(key: DerivedKey) -> CellCipher:
    return CellCipher(key.expand("cells/header", 32), "header")


def _data_cipher(data_key: bytes) -> CellCipher:
    return CellCipher(data_key, "data")


def _pack_header(data_key: bytes, size: int, spread: Plan) -> bytes:
    return _HEADER.pack(data_key, size, spread.blocks.to_bytes(3, "little"), spread.n, spread.k)


def _unpack_header(header: bytes, chunk: int) -> tuple[bytes, int, Plan]:
    data_key, size, blocks, n, k = _HEADER.unpack_from(header)
    try:
        spread = Plan(int.from_bytes(blocks, "little"), n, k, chunk)
    except ValueError as error:
        raise InputError(f"the hidden header is damaged: {error}") from error
    if not 0 < size <= spread.capacity:
        raise InputError(f"the hidden header is damaged: {size} bytes in {spread}")
    return data_key, size, spread


def _close_header(header: bytes, keys: Sequence[DerivedKey], own: list[bytes], degree: int) -> list[bytes]:
    """Closed header cells for the first identities of `own`: every part for every salt, COPIES times."""
    chunk, parts = chunk_bytes(degree), header_parts(degree)
    padded = header.ljust(chunk * parts, b"\0")
    pieces = [padded[start : start + chunk] for start in range(0, len(padded), chunk)]
    identity = iter(own)
    return [
        cipher.close(next(identity), number, piece)
        for cipher in map(_header_cipher, keys)
        for number, piece in enumerate(pieces)
        for _ in range(COPIES)
    ]


def _close_data(sealed: bytes, data_key: bytes, spread: Plan, own: list[bytes]) -> list[bytes]:
    """Closed data cells for all identities of `own`; left-over cells repeat the first chunks."""
    data = np.frombuffer(sealed.ljust(spread.capacity, b"\0"), np.uint8)
    blocks = data.reshape(spread.blocks, spread.k, spread.chunk)
    coded = np.concatenate([reed_solomon.encode(block, spread.n) for block in blocks])
    cipher = _data_cipher(data_key)
    return [
        cipher.close(identity, index % len(coded), coded[index % len(coded)].tobytes())
        for index, identity in enumerate(own)
    ]


def _join(chunks: Iterable[tuple[int, bytes]], spread: Plan, size: int) -> bytes:
    """The sealed payload from numbered chunks in any order. Raises InputError if too few are there."""
    blocks: list[dict[int, npt.NDArray[np.uint8]]] = [{} for _ in range(spread.blocks)]
    for number, chunk in chunks:
        if number < spread.blocks * spread.n:
            blocks[number // spread.n][number % spread.n] = np.frombuffer(chunk, np.uint8)
    decoded = [reed_solomon.decode(rows, spread.k, spread.n) for rows in blocks]
    whole = [block for block in decoded if block is not None]
    if len(whole) < len(decoded):
        raise InputError(
            f"the key is right, but too much of the model was removed: {len(decoded) - len(whole)} of "
            f"{len(decoded)} blocks are lost"
        )
    return np.concatenate(whole).tobytes()[:size]
