"""The header of a secret, which tells how to read it, and the division of carriers between secrets.

Every secret has a *header* in a few carriers: its data key, encrypted for each salt, and its parameters. Its
payload is cut into numbered chunks with Reed-Solomon redundancy, one in each carrier of its share: any
quarter of all Gaussians may be lost. The number of chunks does not reveal the size of the payload.

A key must not reveal whether there are other secrets, so a secret's share depends on its own size only: the
first of a quarter, a half and all of the carriers that holds it. Carriers for the headers of four secrets are
reserved, however many there are. Secrets whose shares do not fit together get equal ones, by which the holder
of one key can notice others.

Parameters are cut into numbered parts, one in a carrier. Numbers are little-endian:

    version (1 byte), method (15, padded with zeros), bytes of the encrypted payload (4); in codes, bytes of a
    block (2); in low bits, Gaussians of the model (4), codewords (4), chunks of one (2), data chunks of one
    (2), a sketch of the Gaussians (32, see `mixing`)
"""

from __future__ import annotations

import math
import struct
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import takewhile

import numpy as np

from keyss.channels.base import METHOD_BYTES, Capacity, pack_method, unpack_method
from keyss.channels.mixing import SKETCH_BYTES
from keyss.channels.quiet.bits import Layout
from keyss.channels.quiet.cells import TAG_BYTES, CellCipher
from keyss.channels.quiet.usable import SALTS
from keyss.channels.reed_solomon import LOST, SYMBOL_BYTES, Codewords
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import InputError, UsageError
from keyss.keys.derivation import DerivedKey
from keyss.keys.encryption import OVERHEAD

DATA_KEY_BYTES = 16
KEY_COPIES = 12  # copies of the data key for each salt
PARAMETER_COPIES = 24  # copies of each part; pruning a quarter removes all of them with p = 4e-15
LEAST_BYTES = 48  # minimum bytes of a block of codes: a key cell, or the parameters
BLOCK_HEADER = 2  # blocks of a secret's header
MIN_BLOCKS = 4  # a salt, a header, and data
TYPICAL_SHARE = 0.75  # usable Gaussians of a trained model; 0.58 to 0.94 were measured

_MAX_INDEPENDENT = 4  # maximum number of secrets with independent shares
_MAX_RESERVED = 1 / 3  # maximum share of the carriers reserved for headers
_REMOVAL = 0.25  # share of the Gaussians that may be removed at random
_FAILURE = 1e-7  # probability of losing a payload to such removal
_NUMBER_BYTES = 3  # size of a chunk's number
_LONGEST = 1024  # chunks per codeword; longer codewords hold little more and are slower
MAX_CODEWORDS = (1 << 8 * _NUMBER_BYTES) // _LONGEST

_VERSION = 6
_PREFIX = struct.Struct(f"<B{METHOD_BYTES}sI")
_BLOCKS = struct.Struct("<H")  # bytes of a block
_CODEWORDS = struct.Struct("<IIHH")  # Gaussians of the model, codewords, chunks of one, data chunks of one
_DAMAGED = "the hidden parameters are damaged"
INCOMPRESSIBLE = 1 - 2**-10  # data that do not compress grow by less than a thousandth, and _ZLIB_BYTES
_ZLIB_BYTES = 16


@dataclass(frozen=True)
class Plan:
    """The division of carriers between payloads."""

    first: int  # carriers before this one are reserved for headers
    shares: list[tuple[int, Codewords]]  # of each payload: carriers, and the codewords in them
    independent: bool  # True if no share depends on other secrets


@dataclass(frozen=True)
class LowBitsCapacity:
    """The capacity of carriers of `width` bytes each."""

    carriers: int
    width: int

    @staticmethod
    def of(carriers: int, sh_degree: int) -> LowBitsCapacity:
        return LowBitsCapacity(carriers, Layout(sh_degree).width)

    def for_payloads(self) -> Capacity:
        """Of these bytes, a half fits into half of the carriers and a quarter into a quarter (see `plan`)."""
        carriers = self._independent_carriers or self._carriers(1)
        size = min(part * self._size(carriers // part) for part in (1, 2, 4))
        return Capacity(
            int(size * INCOMPRESSIBLE),
            OVERHEAD + _ZLIB_BYTES,
            equal=lambda secrets: int(self.payload_capacity(secrets) * INCOMPRESSIBLE),
            divisible=self._independent_carriers > 0,
        )

    @property
    def part_bytes(self) -> int:
        """Bytes of parameters per carrier, without tag and number; 0 if not even a key fits."""
        return self.width - TAG_BYTES - 1 if self.width >= TAG_BYTES + DATA_KEY_BYTES else 0

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk without its number; 0 if nothing fits."""
        size = (self.width - TAG_BYTES - _NUMBER_BYTES) // SYMBOL_BYTES * SYMBOL_BYTES
        return size if self.part_bytes else 0

    @property
    def header_carriers(self) -> int:
        """Carriers of a secret's header."""
        size = _PREFIX.size + _CODEWORDS.size + SKETCH_BYTES
        return SALTS * KEY_COPIES + -(-size // max(1, self.part_bytes)) * PARAMETER_COPIES

    def plan(self, sizes: Sequence[int]) -> Plan:
        """Shares for encrypted payloads of `sizes` bytes.

        Raises UsageError, with the number of Gaussians that would suffice.
        """
        shared = self._independent_carriers if len(sizes) <= _MAX_INDEPENDENT else 0
        counts = [
            next((shared // part for part in (4, 2, 1) if self._codewords(shared // part, size)), None)
            for size in sizes
        ]
        fitting = [count for count in counts if count is not None]
        independent = len(fitting) == len(sizes) and sum(fitting) <= shared
        if not independent:
            fitting = [self._carriers(len(sizes))] * len(sizes)
        shares = []
        for count, size in zip(fitting, sizes, strict=True):
            if (codewords := self._codewords(count, size)) is None:
                raise UsageError(self.too_small(self.carriers, "usable Gaussians", size, len(sizes)))
            shares.append((count, codewords))
        headers = _MAX_INDEPENDENT if independent else len(sizes)
        return Plan(headers * self.header_carriers, shares, independent)

    def payload_capacity(self, secrets: int) -> int:
        """Maximum bytes of each of `secrets` encrypted payloads with equal shares; may be 0."""
        return self._size(self._carriers(secrets))

    def too_small(self, count: int, what: str, size: int, secrets: int) -> str:
        """The message for payloads of `size` bytes that do not fit into `count` of `what`."""
        need = bisect_left(
            range(1 << 30), size, key=lambda each: LowBitsCapacity(each, self.width).payload_capacity(secrets)
        )
        need = math.ceil(need * count / max(1, self.carriers))
        digits = max(0, len(str(need)) - 2)
        rounded = math.ceil(need / 10**digits) * 10**digits
        each = "" if secrets == 1 else f" for each of {secrets} secrets"
        return (
            f"a cover of {count:,} {what} is too small to carry {size:,} bytes{each} in its low bits; "
            f"{rounded:,} Gaussians would do"
        )

    @property
    def _independent_carriers(self) -> int:
        """Carriers for chunks with the headers of four secrets; 0 if these would take too many."""
        reserved = _MAX_INDEPENDENT * self.header_carriers
        return self.carriers - reserved if reserved <= _MAX_RESERVED * self.carriers else 0

    def _carriers(self, secrets: int) -> int:
        """Carriers for the chunks of each of `secrets` payloads with equal shares."""
        return max(0, self.carriers // secrets - self.header_carriers)

    def _size(self, count: int) -> int:
        """Maximum bytes of an encrypted payload in `count` carriers."""
        codewords = self._codewords(count)
        return codewords.size if codewords else 0

    def _codewords(self, count: int, size: int | None = None) -> Codewords | None:
        """The most redundant code of `size` bytes (None: the maximum) in `count` carriers.

        None if its probability of loss exceeds _FAILURE.
        """
        chunk = self.chunk_bytes
        if count < 1 or chunk < 1:
            return None
        number = min(-(-count // _LONGEST), MAX_CODEWORDS)
        n = min(count // number, _LONGEST)
        most = _most_data(n, number)
        k = most if size is None else max(1, -(-size // (chunk * number)))
        return Codewords(number, n, k, chunk) if 0 < k <= most else None


def check_width(layout: Layout) -> None:
    """Raise UsageError if not even a key fits into the low bits of a Gaussian."""
    if not LowBitsCapacity(0, layout.width).part_bytes:
        unit = "" if layout.quats else " with unit quaternions"
        raise UsageError(
            f"a cover of SH degree {layout.sh_degree}{unit} has no room for anything in its low bits"
        )


def check_payload_fits(compressed: int, gaussians: int, secrets: int, sh_degree: int) -> None:
    """Raise UsageError if `compressed` bytes per secret will probably not fit into a model to be trained."""
    check_width(Layout(sh_degree))
    size = compressed + OVERHEAD
    capacity = LowBitsCapacity.of(int(gaussians * TYPICAL_SHARE), sh_degree)
    if capacity.payload_capacity(secrets) < size:
        raise UsageError(capacity.too_small(gaussians, "Gaussians", size, secrets))


def key_cipher(key: DerivedKey) -> CellCipher:
    """The cipher of cells that hold a data key."""
    return CellCipher(key.expand("quiet/key", 32), "key", DATA_KEY_BYTES)


def parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    """The cipher of numbered parts of the parameters, in carriers of `width` bytes."""
    return CellCipher(data_key, "parameters", width - TAG_BYTES)


def chunk_cipher(data_key: bytes, width: int) -> CellCipher:
    """The cipher of numbered chunks, in carriers of `width` bytes."""
    return CellCipher(data_key, "chunk", _NUMBER_BYTES + LowBitsCapacity(0, width).chunk_bytes)


@dataclass(frozen=True)
class Parameters:
    """Parameters of a secret."""

    method: str
    size: int  # bytes of the encrypted payload
    block_bytes: int = 0  # data bytes of a block of codes; 0 in low bits
    codewords: Codewords | None = None  # None in blocks of codes
    gaussians: int = 0  # size of the published model, in low bits
    sketch: bytes = b""

    def parts(self, width: int) -> Bytes:
        """[P, width - TAG_BYTES] numbered parts."""
        packed = _PREFIX.pack(_VERSION, pack_method(self.method), self.size)
        if (code := self.codewords) is not None:
            packed += _CODEWORDS.pack(self.gaussians, code.count, code.n, code.k) + self.sketch
        else:
            packed += _BLOCKS.pack(self.block_bytes)
        size = width - TAG_BYTES - 1
        count = -(-len(packed) // size)
        parts = np.frombuffer(packed.ljust(count * size, b"\0"), np.uint8).reshape(count, size)
        return np.concatenate([np.arange(count, dtype=np.uint8)[:, None], parts], axis=1)


def unpack(parts: Bytes, width: int | None = None) -> Parameters:
    """Parameters from decrypted parts [P, 1 + part] in any order. Raises InputError for damage or loss.

    `width`: bytes of a carrier; None for blocks of codes.
    """
    numbered = {int(row[0]): row[1:].tobytes() for row in parts}
    packed = b"".join(numbered[each] for each in takewhile(numbered.__contains__, range(len(numbered))))
    least = _PREFIX.size + (_BLOCKS.size if width is None else _CODEWORDS.size + SKETCH_BYTES)
    if len(packed) < least:
        raise InputError(LOST)
    version, name, size = _PREFIX.unpack_from(packed)
    if version != _VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {_VERSION}")
    try:
        method = unpack_method(name)
        if width is None:
            return Parameters(method, size, *_BLOCKS.unpack_from(packed, _PREFIX.size))
        gaussians, count, n, k = _CODEWORDS.unpack_from(packed, _PREFIX.size)
        codewords = Codewords(count, n, k, LowBitsCapacity(0, width).chunk_bytes)
    except ValueError as error:
        raise InputError(f"{_DAMAGED}: {error}") from error
    if count > MAX_CODEWORDS or n > _LONGEST or not 0 < size <= codewords.size:
        raise InputError(f"{_DAMAGED}: {size} bytes in {codewords}")
    return Parameters(method, size, 0, codewords, gaussians, packed[least - SKETCH_BYTES : least])


def numbered_chunks(codewords: Codewords, data: bytes, count: int) -> Bytes:
    """[count, _NUMBER_BYTES + width] numbered chunks; those beyond the codewords repeat the first."""
    numbers = np.arange(count, dtype="<u4") % codewords.chunks
    chunks = codewords.encode(data)[numbers]
    return np.concatenate([numbers.view(np.uint8).reshape(-1, 4)[:, :_NUMBER_BYTES], chunks], axis=1)


def split_numbers(chunks: Bytes) -> tuple[Integers, Bytes]:
    """The numbers [C] and the data [C, width] of numbered chunks."""
    numbers: Integers = chunks[:, :_NUMBER_BYTES] @ np.array([1, 1 << 8, 1 << 16])
    return numbers, chunks[:, _NUMBER_BYTES:]


@lru_cache(maxsize=1024)
def _most_data(n: int, count: int) -> int:
    """The largest k with which all codewords survive removal with probability 1 - _FAILURE; 0 if none."""
    from scipy.special import bdtrc  # takes long to load

    data = np.arange(1, n + 1)
    return int(data[bdtrc(n - data, n, _REMOVAL) * count < _FAILURE].max(initial=0))
