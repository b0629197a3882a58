"""How carriers are laid out: the cells of each secret, and the header that tells how to read them.

Every secret has a *header* in a few whole carriers: its data key for each salt, and the parameters for
reading the rest. Its *records* take one cell each; the numbered chunks of a payload are records too.

A key must not reveal whether there are other secrets, so each secret is allocated cells by its own size only:
an *independent* plan. It gets the first size class that holds it: a fifth of the carriers with one record
each; then a quarter, a half and all of the cells that divide carriers into halves (thirds, quarters).

- *Records* take one cell each. If the class has cells left, up to a quarter of the records, those whose loss
  costs most, are embedded twice: copies of 10 % halve the cost of random pruning.
- A *payload* is cut into numbered chunks and fills its class with Reed-Solomon redundancy: any quarter of all
  Gaussians may be lost. The number of cells does not reveal its size.

Carriers for the headers of four secrets are always reserved. Secrets that do not fit independently share all
cells in a joint plan, with fewer copies or smaller cells: the holder of one key can notice others.

Parameters are cut into numbered parts, one in each cell. Numbers are little-endian:

    version (1 byte), service (1), method (15, padded with zeros), cells of a carrier (1), bytes of a record
    (2), bytes of the method's own header (2), Gaussians of the model (4), records (4); in low bits a sketch
    of these Gaussians (32, see `mixing`); then that header
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

from keyss.channels.base import METHOD_BYTES, Capacity, RecordPlan, RecordRequest, pack_method, unpack_method
from keyss.channels.mixing import SKETCH_BYTES
from keyss.channels.quiet.bits import Layout
from keyss.channels.quiet.cells import TAG_BYTES, CellCipher
from keyss.channels.quiet.usable import SALTS
from keyss.channels.reed_solomon import LOST, SYMBOL_BYTES, Codewords
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import InputError, UsageError
from keyss.keys.derivation import DerivedKey
from keyss.keys.encryption import SMALLEST_BUCKET, encrypted_size

DATA_KEY_BYTES = 16
KEY_COPIES = 12  # copies of the data key for each salt
PARAMETER_COPIES = 24  # copies of each part; pruning a quarter removes all of them with p = 4e-15
LEAST_BYTES = 48  # minimum bytes of a block of codes: a key cell, or the parameters
BLOCK_HEADER = 2  # blocks of a secret's header
MIN_BLOCKS = 4  # a salt, a header, and data
_MAX_CELLS = 4  # cells per carrier
_MAX_COPIES = 0.25  # share of a secret's records
_MAX_INDEPENDENT = 4  # maximum number of secrets with independent plans
TYPICAL_SHARE = 0.75  # usable Gaussians of a trained model; 0.58 to 0.94 were measured

_TYPICAL_HEADER = 168  # maximum bytes of a method's header in an independent plan
_MAX_RESERVED = 1 / 3  # maximum share of the carriers reserved for headers
_DEVIATIONS = 6  # margin of the number of untouched carriers, in standard deviations
_REMOVAL = 0.25  # share of the Gaussians that may be removed at random
_FAILURE = 1e-7  # probability of losing a payload to such removal
_NUMBER_BYTES = 3  # size of a chunk's number
MAX_CHUNKS = 1024  # chunks per codeword; longer codewords hold little more and are slower
MAX_CODEWORDS = (1 << 8 * _NUMBER_BYTES) // MAX_CHUNKS

_VERSION = 5
_MAX_HEADER_BYTES = 4096
PAYLOAD, RECORDS = 1, 2  # services
_CODEWORDS = struct.Struct("<IIHH")  # bytes of the encrypted payload, codewords, chunks of one, data chunks
_PREFIX = struct.Struct(f"<BB{METHOD_BYTES}sBHHII")  # parameters before the sketch and the method's header


@dataclass(frozen=True)
class LowBitsCapacity:
    """The capacity of carriers of `width` bytes each, and plans that use it."""

    carriers: int
    width: int

    @staticmethod
    def of(carriers: int, sh_degree: int) -> LowBitsCapacity:
        return LowBitsCapacity(carriers, Layout(sh_degree).width)

    def for_payloads(self) -> Capacity:
        return Capacity(self.carriers, self.payload_capacity(1), SMALLEST_BUCKET)

    @property
    def part_bytes(self) -> int:
        """Bytes of parameters per cell, without tag and number; 0 if not even a key fits."""
        return self.width - TAG_BYTES - 1 if self.width >= TAG_BYTES + DATA_KEY_BYTES else 0

    def record_bytes(self, cells: int) -> int:
        """Bytes of a record with `cells` cells per carrier; 0 if nothing fits."""
        return max(0, self.width // cells - TAG_BYTES) if self.part_bytes else 0

    def header_carriers(self, header_bytes: int) -> int:
        """Carriers of a secret's header; `header_bytes`: size of the method's header."""
        parts = -(-(_PREFIX.size + SKETCH_BYTES + header_bytes) // max(1, self.part_bytes))
        return SALTS * KEY_COPIES + parts * PARAMETER_COPIES

    def reserved(self, header_bytes: Sequence[int], independent: bool) -> int:
        """Carriers reserved for the headers of all secrets."""
        if independent:
            return _MAX_INDEPENDENT * self.header_carriers(_TYPICAL_HEADER)
        return sum(self.header_carriers(each) for each in header_bytes)

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """A plan for each request; plans with several cells per carrier all have the same number.

        Raises UsageError, with the number of records that fit.
        """
        least, largest = max(request.least_bytes for request in requests), self.record_bytes(1)
        if least > largest:
            raise UsageError(
                f"a Gaussian of this cover has room for records of {largest} bytes, and at least {least} are "
                "needed"
            )
        plans = [plan for plan in map(self._independent_plan, requests) if plan is not None]
        if len(plans) < len(requests):
            return self._joint_plans(requests)
        both = zip(plans, requests, strict=True)
        cells = [(plan.cells_per_carrier, request.count + plan.copies) for plan, request in both]
        return plans if self._fits(cells) else self._joint_plans(requests)

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        """The number of records of the minimum size that fit for all requests together."""
        carriers, cells = self._joint(requests)
        return max(0, carriers) * cells

    def max_independent_records(self, least_bytes: int, secrets: int) -> int:
        """The maximum number of records of `least_bytes` for each secret in independent plans."""
        if secrets > _MAX_INDEPENDENT or not self._classes():
            return 0
        cells = self._most_cells(least_bytes)
        return cells * self._independent_carriers // (1 << (secrets - 1).bit_length())

    def plan_payloads(self, sizes: Sequence[int]) -> tuple[list[tuple[int, int, Codewords]], bool]:
        """Cells per carrier, cells and codewords for each encrypted payload of `sizes` bytes.

        And True if these plans are independent. Raises UsageError, with the number of Gaussians that would
        suffice.
        """
        alone = [
            next((each for each in self._classes() if self._codewords(*each, size)), None) for size in sizes
        ]
        cells = [each for each in alone if each is not None]
        if not (independent := len(cells) == len(sizes) and self._fits(cells)):
            cells = [(1, self._payload_cells(len(sizes)))] * len(sizes)
        plans = []
        for each, size in zip(cells, sizes, strict=True):
            if (codewords := self._codewords(*each, size)) is None:
                raise UsageError(self.too_small(self.carriers, "usable Gaussians", size, len(sizes)))
            plans.append((*each, codewords))
        return plans, independent

    def payload_capacity(self, secrets: int) -> int:
        """Maximum bytes of each encrypted payload for `secrets` payloads; may be 0."""
        codewords = self._codewords(1, self._payload_cells(secrets))
        return codewords.size if codewords else 0

    def too_small(self, count: int, what: str, size: int, secrets: int) -> str:
        """The message for payloads of `size` bytes that do not fit; `count` and `what` describe the model."""
        if not self.part_bytes:
            return (
                f"a cover whose Gaussians hold {self.width} bytes has no room for anything in its low bits: "
                "there are 8 at SH degree 0, 21 at degree 1, and 4 less where quaternions have unit length"
            )
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

    def _codewords(self, cells: int, count: int, size: int | None = None) -> Codewords | None:
        """The most redundant code of `size` bytes (None: the maximum) in `count` cells.

        None if the probability of loss exceeds _FAILURE.
        """
        chunk = (self.record_bytes(cells) - _NUMBER_BYTES) // SYMBOL_BYTES * SYMBOL_BYTES
        if count < 1 or chunk < 1:
            return None
        number = min(-(-count // MAX_CHUNKS), MAX_CODEWORDS)
        n = min(count // number, MAX_CHUNKS)
        most = _most_data(n, number)
        k = most if size is None else max(1, -(-size // (chunk * number)))
        return Codewords(number, n, k, chunk) if 0 < k <= most else None

    @property
    def _independent_carriers(self) -> int:
        """Carriers for the records of independent plans."""
        return self.carriers - self.reserved((), independent=True)

    def _classes(self) -> list[tuple[int, int]]:
        """Size classes: (cells per carrier, cells); empty if headers would take too many carriers."""
        shared = self._independent_carriers
        if self.carriers - shared > _MAX_RESERVED * self.carriers:
            return []
        divided = [
            (cells, cells * shared // part) for cells in range(2, _MAX_CELLS + 1) for part in (4, 2, 1)
        ]
        return [(1, shared // 5), *divided]

    def _most_cells(self, least_bytes: int) -> int:
        """The maximum number of cells per carrier for records of `least_bytes`; 0 if none fits."""
        return min(_MAX_CELLS, self.width // (TAG_BYTES + least_bytes)) if self.part_bytes else 0

    def _independent_plan(self, request: RecordRequest) -> RecordPlan | None:
        """The plan that depends on this secret only; None if it does not fit."""
        for cells, count in self._classes() if request.header_bytes <= _TYPICAL_HEADER else ():
            size = self.record_bytes(cells)
            if count >= request.count and size >= request.least_bytes:
                copies = min(int(_MAX_COPIES * request.count), count - request.count)
                return RecordPlan(size, copies, cells, independent=True)
        return None

    def _payload_cells(self, secrets: int) -> int:
        """Whole carriers for each of `secrets` payloads in a joint plan."""
        return (self.carriers - secrets * self.header_carriers(_TYPICAL_HEADER)) // secrets

    def _fits(self, cells: Sequence[tuple[int, int]]) -> bool:
        """True if independent plans fit together; `cells`: (cells per carrier, cells) of each secret.

        Cells that divide carriers are placed first, anywhere; whole carriers then must be untouched.
        """
        shared, whole = (
            sum(count for each, count in cells if (each > 1) == divides) for divides in (True, False)
        )
        carriers, parts = self._independent_carriers, max(each for each, _ in cells)
        if len(cells) > _MAX_INDEPENDENT or len({each for each, _ in cells if each > 1}) > 1:
            return False
        untouched = max(0.0, 1 - shared / (parts * carriers)) ** parts if shared else 1.0
        spare = _DEVIATIONS * (carriers * untouched * (1 - untouched)) ** 0.5
        return shared <= parts * carriers and (not whole or whole <= carriers * untouched - spare)

    def _joint(self, requests: Sequence[RecordRequest]) -> tuple[int, int]:
        """Carriers for the records of joint plans (may be negative), and the maximum of cells in each."""
        headers = self.reserved([each.header_bytes for each in requests], independent=False)
        return self.carriers - headers, self._most_cells(max(each.least_bytes for each in requests))

    def _joint_plans(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """Plans that share all cells: whole carriers, then fewer copies, then smaller cells."""
        count = sum(request.count for request in requests)
        carriers, most = self._joint(requests)
        for cells in range(1, most + 1):
            if count <= cells * carriers:
                copies = min(_MAX_COPIES, (cells * carriers - count) / max(1, count))
                size = self.record_bytes(cells)
                return [RecordPlan(size, int(copies * request.count), cells) for request in requests]
        raise UsageError(
            f"{count:,} Gaussians are too many for this cover: {self.carriers:,} of its Gaussians can carry "
            f"one, and {self.record_capacity(requests):,} would fit"
        )


def check_payload_fits(compressed: int, gaussians: int, secrets: int, sh_degree: int) -> None:
    """Raise UsageError if `compressed` bytes per secret will probably not fit into a model to be trained."""
    size = encrypted_size(compressed)
    capacity = LowBitsCapacity.of(int(gaussians * TYPICAL_SHARE), sh_degree)
    if capacity.payload_capacity(secrets) < size:
        raise UsageError(capacity.too_small(gaussians, "Gaussians", size, secrets))


def key_cipher(key: DerivedKey) -> CellCipher:
    """The cipher of cells that hold a data key."""
    return CellCipher(key.expand("quiet/key", 32), "key", DATA_KEY_BYTES)


def parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    """The cipher of numbered parts of the parameters, in carriers of `width` bytes."""
    return CellCipher(data_key, "parameters", width - TAG_BYTES)


@dataclass(frozen=True)
class Parameters:
    """Parameters of a secret: `count` records and copies of `record_bytes`, `cells` per carrier."""

    service: int
    method: str
    cells: int
    record_bytes: int
    gaussians: int  # size of the published model
    count: int
    header: bytes
    sketch: bytes = b""  # empty in blocks

    def parts(self, width: int) -> Bytes:
        """[P, width - TAG_BYTES] numbered parts."""
        numbers = self.cells, self.record_bytes, len(self.header), self.gaussians, self.count
        packed = (
            _PREFIX.pack(_VERSION, self.service, pack_method(self.method), *numbers)
            + self.sketch
            + self.header
        )
        size = width - TAG_BYTES - 1
        count = -(-len(packed) // size)
        parts = np.frombuffer(packed.ljust(count * size, b"\0"), np.uint8).reshape(count, size)
        return np.concatenate([np.arange(count, dtype=np.uint8)[:, None], parts], axis=1)


def unpack(parts: Bytes, sketch_bytes: int = SKETCH_BYTES) -> Parameters:
    """Parameters from decrypted parts [P, 1 + part] in any order. Raises InputError for damage or loss.

    `sketch_bytes`: 0 in blocks.
    """
    numbered = {int(row[0]): row[1:].tobytes() for row in parts}
    packed = b"".join(numbered[each] for each in takewhile(numbered.__contains__, range(len(numbered))))
    if len(packed) < _PREFIX.size:
        raise InputError(LOST)
    version, service, name, cells, size, length, gaussians, count = _PREFIX.unpack_from(packed)
    if version != _VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {_VERSION}")
    if service not in (PAYLOAD, RECORDS) or not 1 <= cells <= _MAX_CELLS or length > _MAX_HEADER_BYTES:
        raise InputError(
            f"the hidden parameters are damaged: service {service}, {cells} cells of a carrier, {length} "
            "bytes of header"
        )
    try:
        method = unpack_method(name)
    except ValueError as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    header, end = _PREFIX.size + sketch_bytes, _PREFIX.size + sketch_bytes + length
    if len(packed) < end:
        raise InputError(LOST)
    own, sketch = packed[header:end], packed[_PREFIX.size : header]
    return Parameters(service, method, cells, size, gaussians, count, own, sketch)


def pack_codewords(size: int, codewords: Codewords) -> bytes:
    """The header of a payload of `size` encrypted bytes in low bits."""
    return _CODEWORDS.pack(size, codewords.count, codewords.n, codewords.k)


def unpack_codewords(header: bytes, record_bytes: int) -> tuple[int, Codewords]:
    """Invert `pack_codewords`. Raises InputError for impossible numbers."""
    try:
        size, count, n, k = _CODEWORDS.unpack(header)
        codewords = Codewords(count, n, k, record_bytes - _NUMBER_BYTES)
        if codewords.chunks > MAX_CODEWORDS * MAX_CHUNKS or not 0 < size <= codewords.size:
            raise ValueError(f"{size} bytes in {codewords}")
    except (ValueError, struct.error) as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    return size, codewords


def numbered_chunks(codewords: Codewords, data: bytes, cells: int) -> Bytes:
    """[cells, _NUMBER_BYTES + width] numbered chunks; spare cells repeat the first ones."""
    numbers = np.arange(cells, dtype="<u4") % codewords.chunks
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
