"""How many cells each secret gets among the carriers, and how many cells divide one.

Every secret has a *header* in a few whole carriers: its data key for each salt, and the parameters for
reading the rest. Beside it come *records*, one in each cell; numbered chunks of a payload are records too.

A key must not tell whether there are other secrets: what a secret gets follows from its own size. There are
size classes, in which several secrets fit beside each other as each would alone: a fifth of the carriers, for
one record each; then a quarter, half and all of the cells that divide carriers into halves (or thirds,
quarters).

- *Records* take as many cells of the first class that has room as there are. Up to a quarter of them, those
  whose loss costs most, are embedded twice if the class has room for that: a copy of 10 % takes away half of
  the cost of random pruning.
- A *payload* fills its class with redundancy.

Carriers for the headers of four secrets are set aside, whether there are so many or not. Secrets that do not
fit like that get what there is, without copies or in smaller cells, and the holder of one key can notice the
others.

An encrypted payload is cut into numbered chunks, coded with Reed-Solomon so that the loss of a quarter of all
Gaussians, whichever they are, leaves enough of every codeword. A payload fills all cells that it gets: those
that it does not need become redundancy, and the number of cells tells nothing.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from keyss.channels.base import RecordPlan, RecordRequest, Room
from keyss.channels.quiet.bits import Layout
from keyss.channels.quiet.cells import TAG_BYTES
from keyss.channels.reed_solomon import SYMBOL_BYTES, Codewords
from keyss.channels.sketch import SKETCH_BYTES
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import UsageError
from keyss.keys.encryption import SMALLEST_BUCKET, encrypted_size

DATA_KEY_BYTES = 16
SALTS = 12  # Gaussians that may serve as the salt: random pruning of a quarter removes all with p = 6e-8
KEY_COPIES = 12  # of the data key, for each salt
PARAMETER_COPIES = 24  # of each part: all are removed with a quarter of the model with p = 4e-15
PREFIX_BYTES = 30  # of the parameters before the sketch and a method's own header (see `parameters`)
LEAST_BYTES = 48  # that every block of codes holds: a key cell, or the parameters
BLOCK_HEADER = 2  # blocks of codes that a secret's header takes
MIN_BLOCKS = 4  # a salt, a header, and data
MAX_CELLS = 4  # of a carrier
MAX_COPIES = 0.25  # of a secret's records
UNNOTICED = 4  # secrets that fit beside each other, if they are small enough, as each would alone
TYPICAL_SHARE = 0.75  # Gaussians whose low bits are random, of a trained model; 0.58 to 0.94 were measured

_TYPICAL_HEADER = 168  # bytes that the methods' own headers take at most
_MAX_SET_ASIDE = 1 / 3  # of the carriers, for headers of secrets that there may not be
_DEVIATIONS = 6  # by which carriers that are left untouched may be fewer than expected
REMOVAL = 0.25  # share of the Gaussians that may be removed at random
FAILURE = 1e-7  # probability that a payload is lost all the same
NUMBER_BYTES = 3  # of a chunk
MAX_CHUNKS = 1024  # of a codeword: longer ones hold a little more and take longer
MAX_CODEWORDS = (1 << 8 * NUMBER_BYTES) // MAX_CHUNKS


@dataclass(frozen=True)
class PayloadPlan:
    """The cells of a payload."""

    cells_per_carrier: int
    cells: int
    codewords: Codewords


@dataclass(frozen=True)
class LowBitsRoom:
    """The room in carriers of `width` bytes each."""

    carriers: int
    width: int

    @staticmethod
    def of(carriers: int, sh_degree: int) -> LowBitsRoom:
        return LowBitsRoom(carriers, Layout(sh_degree).width)

    def for_payloads(self) -> Room:
        return Room(self.carriers, self.payload_capacity(1), SMALLEST_BUCKET)

    @property
    def part_bytes(self) -> int:
        """Bytes of parameters in one cell, beside its tag and its number; 0 where nothing fits at all."""
        return self.width - TAG_BYTES - 1 if self.width >= TAG_BYTES + DATA_KEY_BYTES else 0

    def record_bytes(self, cells: int) -> int:
        """Bytes of a record where `cells` of them divide a carrier; 0 where nothing fits."""
        return max(0, self.width // cells - TAG_BYTES) if self.part_bytes else 0

    def header_carriers(self, header_bytes: int) -> int:
        """Carriers that a secret's header takes; `header_bytes`: what the method adds to the parameters."""
        parts = -(-(PREFIX_BYTES + SKETCH_BYTES + header_bytes) // max(1, self.part_bytes))
        return SALTS * KEY_COPIES + parts * PARAMETER_COPIES

    def set_aside(self, header_bytes: Sequence[int], as_alone: bool) -> int:
        """Carriers for the headers of all secrets."""
        if as_alone:
            return UNNOTICED * self.header_carriers(_TYPICAL_HEADER)
        return sum(self.header_carriers(each) for each in header_bytes)

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """A plan for each of the requests; those with more than one cell of a carrier have equally many.

        Raises UsageError with the number of records that fits.
        """
        least, largest = max(request.least_bytes for request in requests), self.record_bytes(1)
        if least > largest:
            raise UsageError(
                f"a Gaussian of this cover has room for records of {largest} bytes, and at least {least} are "
                "needed"
            )
        plans = [plan for plan in map(self._alone, requests) if plan is not None]
        return plans if self.is_independent_layout(plans, requests) else self._tight(requests)

    def is_independent_layout(self, plans: Sequence[RecordPlan], requests: Sequence[RecordRequest]) -> bool:
        """True if each secret's records are placed as they would be without the others."""
        if list(map(self._alone, requests)) != list(plans):
            return False
        both = zip(plans, requests, strict=True)
        return self._fit([(plan.cells_per_carrier, request.count + plan.copies) for plan, request in both])

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        """Records of the smallest useful size that fit for all requests together; 0 if none."""
        left = self.carriers - self.set_aside([each.header_bytes for each in requests], as_alone=False)
        return max(0, left) * self._most_cells(max(request.least_bytes for request in requests))

    def unnoticed_records(self, least_bytes: int, secrets: int) -> int:
        """The most records of `least_bytes` for each secret that are placed as without the others; or 0."""
        if secrets > UNNOTICED or not self._classes():
            return 0
        cells = self._most_cells(least_bytes)
        return cells * self._shared // (1 << (secrets - 1).bit_length())

    def plan_payloads(self, sizes: Sequence[int]) -> tuple[list[PayloadPlan], bool]:
        """A plan for each encrypted payload of so many bytes; whether each is placed as without the others.

        Raises UsageError with the number of carriers that would do.
        """
        alone = [
            next((each for each in self._classes() if self._codewords(*each, size)), None) for size in sizes
        ]
        cells = [each for each in alone if each is not None]
        if not (as_alone := len(cells) == len(sizes) and self._fit(cells)):
            cells = [(1, self._payload_cells(len(sizes)))] * len(sizes)
        plans = []
        for each, size in zip(cells, sizes, strict=True):
            if (codewords := self._codewords(*each, size)) is None:
                raise UsageError(self.too_small(self.carriers, "usable Gaussians", size, len(sizes)))
            plans.append(PayloadPlan(*each, codewords))
        return plans, as_alone

    def payload_capacity(self, secrets: int) -> int:
        """Bytes of encrypted payload for each of `secrets`; may be 0."""
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
            range(1 << 30), size, key=lambda each: LowBitsRoom(each, self.width).payload_capacity(secrets)
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
        """The most redundant way to spread `size` bytes, or as many as can be, over `count` such cells.

        None: not safe.
        """
        chunk = (self.record_bytes(cells) - NUMBER_BYTES) // SYMBOL_BYTES * SYMBOL_BYTES
        if count < 1 or chunk < 1:
            return None
        number = min(-(-count // MAX_CHUNKS), MAX_CODEWORDS)
        n = min(count // number, MAX_CHUNKS)
        most = _most_data(n, number)
        k = most if size is None else max(1, -(-size // (chunk * number)))
        return Codewords(number, n, k, chunk) if 0 < k <= most else None

    @property
    def _shared(self) -> int:
        """Carriers that the headers leave where each secret is placed as without the others."""
        return self.carriers - self.set_aside((), as_alone=True)

    def _classes(self) -> list[tuple[int, int]]:
        """Cells of a carrier, and cells in all; none where headers take too much."""
        shared = self._shared
        if self.carriers - shared > _MAX_SET_ASIDE * self.carriers:
            return []
        divided = [(cells, cells * shared // part) for cells in range(2, MAX_CELLS + 1) for part in (4, 2, 1)]
        return [(1, shared // 5), *divided]

    def _most_cells(self, least_bytes: int) -> int:
        """Into how many cells a carrier can be divided for records of so many bytes; 0 if they do not fit."""
        cells = [each for each in range(1, MAX_CELLS + 1) if self.record_bytes(each) >= least_bytes]
        return max(cells, default=0)

    def _alone(self, request: RecordRequest) -> RecordPlan | None:
        """The plan of a secret for itself; None where it needs what is set aside for others."""
        for cells, room in self._classes() if request.header_bytes <= _TYPICAL_HEADER else ():
            size = self.record_bytes(cells)
            if room >= request.count and size >= request.least_bytes:
                return RecordPlan(size, min(int(MAX_COPIES * request.count), room - request.count), cells)
        return None

    def _payload_cells(self, secrets: int) -> int:
        """Whole carriers for each of so many payloads that do not fit as they would without the others."""
        return (self.carriers - secrets * self.header_carriers(_TYPICAL_HEADER)) // secrets

    def _fit(self, cells: Sequence[tuple[int, int]]) -> bool:
        """True if the cells of all secrets fit: of each those of a carrier, and their number.

        Cells that divide carriers come first, anywhere; then the others on carriers left untouched.
        """
        shared, whole = (
            sum(count for each, count in cells if (each > 1) == divides) for divides in (True, False)
        )
        carriers, parts = self._shared, max(each for each, _ in cells)
        if len(cells) > UNNOTICED or len({each for each, _ in cells if each > 1}) > 1:
            return False
        untouched = max(0.0, 1 - shared / (parts * carriers)) ** parts if shared else 1.0
        spare = _DEVIATIONS * (carriers * untouched * (1 - untouched)) ** 0.5
        return shared <= parts * carriers and (not whole or whole <= carriers * untouched - spare)

    def _tight(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """All that there is for these secrets: whole carriers, then fewer copies, then smaller cells."""
        left = self.carriers - self.set_aside([each.header_bytes for each in requests], as_alone=False)
        count = sum(request.count for request in requests)
        least = max(request.least_bytes for request in requests)
        for cells in range(1, self._most_cells(least) + 1):
            if count <= cells * left:
                copies = min(MAX_COPIES, (cells * left - count) / max(1, count))
                return [
                    RecordPlan(self.record_bytes(cells), int(copies * request.count), cells)
                    for request in requests
                ]
        raise UsageError(
            f"{count:,} Gaussians are too many for this cover: {self.carriers:,} of its Gaussians can carry "
            f"something, and {self.record_capacity(requests):,} would fit"
        )


def check_payload_fits(compressed: int, gaussians: int, secrets: int, sh_degree: int) -> None:
    """Raise UsageError if `compressed` bytes for each secret will hardly fit into a model to be trained."""
    size = encrypted_size(compressed)
    room = LowBitsRoom.of(int(gaussians * TYPICAL_SHARE), sh_degree)
    if room.payload_capacity(secrets) < size:
        raise UsageError(room.too_small(gaussians, "Gaussians", size, secrets))


def numbered_chunks(codewords: Codewords, data: bytes, cells: int) -> Bytes:
    """[cells, NUMBER_BYTES + width] numbered chunks; those that are left over repeat the first ones."""
    numbers = np.arange(cells, dtype="<u4") % codewords.chunks
    chunks = codewords.encode(data)[numbers]
    return np.concatenate([numbers.view(np.uint8).reshape(-1, 4)[:, :NUMBER_BYTES], chunks], axis=1)


def split_numbers(chunks: Bytes) -> tuple[Integers, Bytes]:
    """The numbers [C] and the data [C, width] of numbered chunks."""
    numbers: Integers = chunks[:, :NUMBER_BYTES] @ np.array([1, 1 << 8, 1 << 16])
    return numbers, chunks[:, NUMBER_BYTES:]


@lru_cache(maxsize=1024)
def _most_data(n: int, count: int) -> int:
    """The largest k with which all codewords survive removal with probability 1 - FAILURE; 0 if none."""
    from scipy.special import bdtrc  # takes long to load

    data = np.arange(1, n + 1)
    return int(data[bdtrc(n - data, n, REMOVAL) * count < FAILURE].max(initial=0))
