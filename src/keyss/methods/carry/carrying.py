"""Whole models in the low bits of another: each secret Gaussian rides in one of the cover's.

As in `keyss.channels.low_bits.container` there is nothing to be recognised: no magic number, no table, no
order. What a key opens is found by opening every Gaussian's cell and keeping those whose tag fits.

- *Key cells*, closed under what the key becomes with the salt, hold the secret's data key. The salt is the
  container's: a hash of the Gaussian with the smallest identity, and because that one may be removed, there
  are key cells for each of the 12 smallest.
- *Parameter cells*, closed under the data key, say how records are to be read, 24 times.
- *Records*, closed under the data key, are a quantised Gaussian each (see `quantise`) and need no number:
  shuffling and cropping are harmless, and who removes a carrier removes what it carries and no more. *Copies*
  of the most visible ones are told from records by another label; they count where the record is gone.

Which carrier gets what is drawn at random, so that a secret Gaussian's carrier says nothing about it. All
carriers that carry nothing get noise: cells of other secrets and of none look alike. The random numbers come
from the system unless the caller gives them: if they followed from cover and secret, the holder of one key
could compute what the file would be without other secrets.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from keyss.channels.low_bits import model_bits
from keyss.channels.low_bits.bits import bytes_per_gaussian, check_natural, is_random
from keyss.channels.low_bits.byte_plan import COPIES, SALTS
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.channels.low_bits.container import derivation_of, smallest
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey, expand, stream
from keyss.methods.carry.plan import (
    DATA_KEY_BYTES,
    MOST_CELLS,
    PARAMETER_COPIES,
    PREFIX_BYTES,
    Layout,
    Size,
    check_degrees,
    part_bytes,
    plan,
)
from keyss.methods.carry.quantise import Codec
from keyss.methods.carry.thinning import visible_rows

VERSION = 1
LEAST_USABLE = 0.5  # share of the cover's Gaussians that must have random low bits
SALTS_TRIED = 4  # of a model half of whose Gaussians were changed, 15 of 16 then open
_PREFIX = struct.Struct("<BBI")

Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Carried:
    """A secret as it comes out."""

    gaussians: Gaussians  # those that are left, in the order of their carriers
    count: int  # how many were put in
    bits: int  # of a record

    def fingerprint(self) -> str:
        """By which a whole secret can be recognised; says nothing without it."""
        return hashlib.sha256(self.gaussians.means.numpy().tobytes()).hexdigest()[:16]


@dataclass(frozen=True)
class Carriers:
    """A stego model as a reader sees it."""

    names: Bytes  # [N, 16] identities
    low: Bytes  # [N, B] low bits

    @staticmethod
    def of(stego: Gaussians) -> Carriers:
        return Carriers(model_bits.identities(stego), model_bits.read_low_bits(stego))

    def salts(self) -> list[bytes]:
        """The identities that may serve as salt, the one to be tried first first."""
        return salts(self.names)


def usable_carriers(cover: Gaussians) -> Flags:
    """[N] which Gaussians can carry something. Raises InputError for a model without random low bits."""
    usable = is_random(cover)
    if usable.mean() < LEAST_USABLE:
        raise InputError(
            f"only {usable.mean():.0%} of the cover's Gaussians have random low bits, the others hold short "
            "or repeated values: it was quantised or hardly trained, and what is put there could be seen; "
            "--dither gives it new low bits, at a price, and --method learned --sidecar needs none"
        )
    try:
        check_natural(cover, usable)
    except InputError as error:
        raise InputError(f"{error}; or --dither, which gives it new low bits at a price") from error
    return usable


def salts(names: Bytes) -> list[bytes]:
    """Of identities [N, 16] those that may serve as salt, in ascending order."""
    prefixes = names[:, :8].copy().view(">u8")[:, 0]
    least = np.unique(prefixes)[:SALTS]
    return smallest(row.tobytes() for row in names[prefixes <= least[-1]]) if len(least) else []


def embed(
    cover: Gaussians, secrets: Sequence[tuple[str, Gaussians]], *, entropy: bytes | None = None
) -> Gaussians:
    """`cover` with one (key, model) per secret in its low bits; nothing else of it changes.

    `entropy`: 32 bytes that nobody else can know, from which all that is random is derived; by default the
    system's. Takes 1.6 s per secret for key derivation. Raises UsageError for equal keys and for secrets that
    are too large, with the number that fits; InputError for a cover whose low bits are not random.
    """
    derived = derive_all(cover, [key for key, _ in secrets])
    return embed_derived(
        cover, list(zip(derived, (model for _, model in secrets), strict=True)), entropy=entropy
    )


def derive_all(cover: Gaussians, keys: Sequence[str]) -> list[list[DerivedKey]]:
    """What each of the keys becomes under each of the salts; takes 1.6 s a key."""
    derivations = [derivation_of(identity) for identity in salts(model_bits.identities(cover))]
    return [[DerivedKey(key, each) for each in derivations] for key in keys]


def embed_derived(
    cover: Gaussians,
    secrets: Sequence[tuple[Sequence[DerivedKey], Gaussians]],
    *,
    usable: Flags | None = None,
    entropy: bytes | None = None,
) -> Gaussians:
    """`embed` after key derivation: of every secret its key under each of the salts, and the model.

    `usable`: the cover's `usable_carriers`, if they are known already.
    """
    if len({keys[0].verifier() for keys, _ in secrets}) != len(secrets) or not secrets:
        raise UsageError("expected at least one secret, and another key for each")
    sizes = [Size(len(model), model.sh_degree) for _, model in secrets]
    check_degrees(sizes, cover.sh_degree)
    usable = usable_carriers(cover) if usable is None else usable
    rows = np.flatnonzero(usable)
    layouts = plan(sizes, len(rows), len(cover), cover.sh_degree)

    entropy = os.urandom(32) if entropy is None else entropy
    order = np.frombuffer(stream(entropy, "carry/order", 8 * len(rows)), "<u8")
    rows = rows[np.argsort(order, kind="stable")]
    writer = _Writer(entropy, model_bits.identities(cover)[rows], cover.sh_degree)
    data_keys = [expand(entropy, f"carry/data-key/{i}", DATA_KEY_BYTES) for i in range(len(secrets))]
    codecs = [Codec.fit(model, layout.table) for (_, model), layout in zip(secrets, layouts, strict=True)]
    for (keys, model), layout, codec, data_key in zip(secrets, layouts, codecs, data_keys, strict=True):
        writer.header(keys, data_key, _pack_parameters(layout, codec, len(model)))
    ordered = sorted(range(len(secrets)), key=lambda i: layouts[i].cells)  # whole carriers first
    for i in ordered:
        records, copied = codecs[i].encode(secrets[i][1]), visible_rows(secrets[i][1], layouts[i].copies)
        writer.records(_record_cipher(data_keys[i], codecs[i]), records, layouts[i].cells)
        writer.records(_copy_cipher(data_keys[i], codecs[i]), records[copied], layouts[i].cells)
    return model_bits.write_low_bits(cover, rows, writer.table)


def extract(stego: Gaussians, key: str) -> Carried:
    """The model that `key` opens in `stego`.

    Raises WrongKeyError when it opens nothing, and InputError when too much was removed to read the rest.
    If the first salt opens nothing others are tried, SALTS_TRIED in all: changed or added Gaussians may have
    taken the first ones' places, and should not lock out the key.
    """
    carriers = Carriers.of(stego)
    for identity in carriers.salts()[:SALTS_TRIED]:
        try:
            return extract_derived(carriers, DerivedKey(key, derivation_of(identity)))
        except WrongKeyError:
            continue
    raise WrongKeyError("this key opens nothing here")


def extract_derived(carriers: Carriers, key: DerivedKey) -> Carried:
    """`extract` after key derivation."""
    width = carriers.low.shape[1]
    if width < TAG_BYTES + DATA_KEY_BYTES:
        raise WrongKeyError("this key opens nothing here")
    _, opened = _key_cipher(key).open(carriers.names, carriers.low)
    if not len(opened):
        raise WrongKeyError("this key opens nothing here")
    data_key = Counter(map(bytes, opened)).most_common(1)[0][0]
    _, opened = _parameter_cipher(data_key, width).open(carriers.names, carriers.low)
    if not len(opened):  # by chance the tag of a key cell fits once in 2^32
        raise WrongKeyError("this key opens nothing here")
    cells, count, codec = _unpack_parameters({int(part[0]): part[1:].tobytes() for part in opened})
    size = width // cells
    if TAG_BYTES + codec.record_bytes > size:
        raise InputError("the hidden parameters are damaged: records larger than their cells")
    records = _open_cells(carriers, _record_cipher(data_key, codec), cells)
    copies = _open_cells(carriers, _copy_cipher(data_key, codec), cells)
    records = np.concatenate([records, copies[~_are_among(copies, records)]])
    if not len(records):
        raise InputError("the key is right, but nothing is left of what it opens")
    return Carried(codec.decode(records), count, codec.table.total)


def _open_cells(carriers: Carriers, cipher: CellCipher, cells: int) -> Bytes:
    """[M, size] what the cipher opens, in the order of the carriers."""
    size = carriers.low.shape[1] // cells
    found = [
        cipher.open(carriers.names, carriers.low[:, slot * size : (slot + 1) * size], slot)
        for slot in range(cells)
    ]
    origin = np.concatenate([np.flatnonzero(fits) for fits, _ in found])
    return np.concatenate([data for _, data in found])[np.argsort(origin, kind="stable")]


def _are_among(rows: Bytes, others: Bytes) -> Flags:
    """[R] which of the rows are there among the others."""
    code = f"S{rows.shape[1]}"  # bytes of a fixed length: zeros at their end make no difference
    return np.isin(rows.view(code)[:, 0], others.view(code)[:, 0])


class _Writer:
    """Fills the carriers, which come in random order: first headers, then records, the rest stays noise."""

    def __init__(self, entropy: bytes, names: Bytes, sh_degree: int) -> None:
        self._names, self._degree = names, sh_degree
        width = bytes_per_gaussian(sh_degree)
        noise = stream(entropy, "carry/noise", len(names) * width)
        self.table = np.frombuffer(bytearray(noise), np.uint8).reshape(len(names), width)
        self._turns = np.frombuffer(stream(entropy, "carry/turns", len(names)), np.uint8)
        self._next = 0  # carrier that is not in use yet
        self._shared = 0  # cells in use of those that are divided

    def header(self, keys: Sequence[DerivedKey], data_key: bytes, parameters: bytes) -> None:
        for key in keys:
            self._whole(_key_cipher(key), np.frombuffer(data_key * COPIES, np.uint8).reshape(COPIES, -1))
        size = part_bytes(self._degree)
        parts = [
            bytes([number]) + parameters[start : start + size].ljust(size, b"\0")
            for number, start in enumerate(range(0, len(parameters), size))
        ]
        table = np.frombuffer(b"".join(parts * PARAMETER_COPIES), np.uint8).reshape(-1, 1 + size)
        self._whole(_parameter_cipher(data_key, self.table.shape[1]), table)

    def records(self, cipher: CellCipher, records: Bytes, cells: int) -> None:
        if cells == 1:
            self._whole(cipher, records)
            return
        # Those with more cells come last, and all of them have equally many: carrier by carrier, then again
        # from the first one, each time with the next of its cells, from a random one on.
        carriers = len(self.table) - self._next
        number = self._shared + np.arange(len(records))
        self._shared += len(records)
        row = self._next + number % carriers
        slot = (number // carriers + self._turns[row]) % cells
        column = (slot * (self.table.shape[1] // cells))[:, None] + np.arange(cipher.cell_bytes)
        self.table[row[:, None], column] = cipher.close(self._names[row], records, slot)

    def _whole(self, cipher: CellCipher, data: Bytes) -> None:
        rows = slice(self._next, self._next + len(data))
        self.table[rows, : cipher.cell_bytes] = cipher.close(self._names[rows], data)
        self._next += len(data)


def _key_cipher(key: DerivedKey) -> CellCipher:
    return CellCipher(key.expand("carry/key", 32), "carry/key", DATA_KEY_BYTES)


def _parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    return CellCipher(data_key, "carry/parameters", width - TAG_BYTES)


def _record_cipher(data_key: bytes, codec: Codec) -> CellCipher:
    return CellCipher(data_key, "carry/record", codec.record_bytes)


def _copy_cipher(data_key: bytes, codec: Codec) -> CellCipher:
    return CellCipher(data_key, "carry/copy", codec.record_bytes)


def _pack_parameters(layout: Layout, codec: Codec, count: int) -> bytes:
    return _PREFIX.pack(VERSION, layout.cells, count) + codec.pack()


def _unpack_parameters(parts: dict[int, bytes]) -> tuple[int, int, Codec]:
    """(cells of a carrier, Gaussians that were put in, codec). Raises InputError."""
    lost = InputError("the key is right, but too much of the model was removed")
    if 0 not in parts:
        raise lost
    version, cells, count = _PREFIX.unpack_from(parts[0])
    if version != VERSION:
        raise InputError(f"carried secret of version {version}; this program reads version {VERSION}")
    if not 1 <= cells <= MOST_CELLS:
        raise InputError(f"the hidden parameters are damaged: {cells} cells of a carrier")
    needed = -(-(PREFIX_BYTES + Codec.size_from(parts[0][PREFIX_BYTES:])) // len(parts[0]))
    data = b""
    for number in range(needed):
        if number not in parts:
            raise lost
        data += parts[number]
    return cells, count, Codec.unpack(data[PREFIX_BYTES:])
