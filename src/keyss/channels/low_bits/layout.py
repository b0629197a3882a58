"""Where headers, payloads and records lie among the carriers, and how many records share one.

Every secret has a *header* in a few whole carriers: its data key for each salt, and parameters that tell how
the rest is read. Beside it come a payload's chunks, or records.

What a secret gets follows from its own size, so that its key does not tell whether there are others. There
are size classes, in which several secrets fit beside each other as each would alone:

- A *payload* gets a quarter of the carriers if that is enough, else half. What it does not need becomes
  redundancy, so that the number of its cells tells nothing.
- *Records* have carriers of their own, one record each, if they take no more than a fifth. Those of a larger
  secret divide carriers into halves (or thirds, quarters). Up to a quarter of the records, those whose loss
  costs most, are embedded twice, if with them the secret keeps to the least of a quarter, a half and all of
  the cells that has room for it: a copy of 10 % takes away half of what random pruning costs. Carriers for
  the headers of four secrets are set aside, whether there are so many or not.

Where secrets do not fit so (`Arrangement.as_alone`), all do without copies or get smaller cells, and the
holder of one key can notice that there are others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from keyss.channels.base import RecordPlan, RecordRequest
from keyss.channels.low_bits.cells import TAG_BYTES
from keyss.core.errors import UsageError

DATA_KEY_BYTES = 16
SALTS = 12  # Gaussians that may serve as the salt: random pruning of a quarter removes all with p = 6e-8
KEY_COPIES = 12  # of the data key, for each salt
PARAMETER_COPIES = 24  # of each part: all are removed with a quarter of the model with p = 4e-15
PREFIX_BYTES = 40  # of the parameters before a method's own header (see `parameters`)
MAX_CELLS = 4  # of a carrier
MAX_COPIES = 0.25  # of a secret's records
UNNOTICED = 4  # secrets that fit beside each other, if they are small enough, as each would alone

_TYPICAL_HEADER = 168  # bytes that the methods' own headers take at most
_MAX_SET_ASIDE = 1 / 3  # of the carriers, for headers of secrets that there may not be
_DEVIATIONS = 6  # by which carriers that are left untouched may be fewer than expected


@dataclass(frozen=True)
class Arrangement:
    """How records are placed; see `Carriers.arrangement`."""

    header_carriers: int  # set aside for all headers together
    as_alone: bool  # whether each secret has what it would have if it were the only one


@dataclass(frozen=True)
class Carriers:
    """So many carriers, each of `width` bytes."""

    carriers: int
    width: int

    grows = False

    @property
    def part_bytes(self) -> int:
        """Bytes of parameters in one cell, beside its tag and its number; 0 where nothing fits at all."""
        return self.width - TAG_BYTES - 1 if self.width >= TAG_BYTES + DATA_KEY_BYTES else 0

    def header_carriers(self, header_bytes: int) -> int:
        """Carriers that a secret's header takes; `header_bytes`: what the method adds to the parameters."""
        parts = -(-(PREFIX_BYTES + header_bytes) // max(1, self.part_bytes))
        return SALTS * KEY_COPIES + parts * PARAMETER_COPIES

    def record_bytes(self, cells: int) -> int:
        """Bytes of a record where `cells` of them divide a carrier; 0 where nothing fits."""
        return max(0, self.width // cells - TAG_BYTES) if self.part_bytes else 0

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """A plan for each of the requests; those with more than one cell of a carrier have equally many.

        Raises UsageError with the number of records that fits.
        """
        least, most = max(request.least_bytes for request in requests), self.record_bytes(1)
        if least > most:
            raise UsageError(
                f"a Gaussian of this cover has room for records of {most} bytes, and at least {least} are "
                "needed"
            )
        alone = [self._alone(request) for request in requests]
        plans = [plan for plan in alone if plan is not None]
        if len(plans) == len(requests) and self._fit_as_alone(plans, requests):
            return plans
        return self._tight(requests)

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        """Records of the smallest useful size that fit for all requests together; 0 if none."""
        left = self.carriers - self._headers(requests)
        least = max(request.least_bytes for request in requests)
        cells = [each for each in range(1, MAX_CELLS + 1) if self.record_bytes(each) >= least]
        return max(0, left) * max(cells, default=0)

    def unnoticed_records(self, least_bytes: int, secrets: int) -> int:
        """Records that each of so many secrets may have so that all lie as each would alone; 0 if none may.

        `least_bytes`: of a record.
        """
        cells = [each for each in range(1, MAX_CELLS + 1) if self.record_bytes(each) >= least_bytes]
        if not cells or secrets > UNNOTICED or self._set_aside > _MAX_SET_ASIDE * self.carriers:
            return 0
        return cells[-1] * (self.carriers - self._set_aside) // (1 << (secrets - 1).bit_length())

    def arrangement(self, plans: Sequence[RecordPlan], requests: Sequence[RecordRequest]) -> Arrangement:
        """How records so planned are placed."""
        as_alone = [self._alone(request) for request in requests] == list(plans)
        if as_alone and self._fit_as_alone(plans, requests):
            return Arrangement(self._set_aside, as_alone=True)
        return Arrangement(self._headers(requests), as_alone=len(requests) == 1)

    @property
    def _set_aside(self) -> int:
        return UNNOTICED * self.header_carriers(_TYPICAL_HEADER)

    def _headers(self, requests: Sequence[RecordRequest]) -> int:
        return sum(self.header_carriers(request.header_bytes) for request in requests)

    def _alone(self, request: RecordRequest) -> RecordPlan | None:
        """What suits a secret for itself; None where it needs what is set aside for others."""
        most = self.carriers - self._set_aside
        if self._set_aside > _MAX_SET_ASIDE * self.carriers or request.header_bytes > _TYPICAL_HEADER:
            return None
        for cells in range(1, MAX_CELLS + 1):
            size = self.record_bytes(cells)
            classes = [most // 5] if cells == 1 else [cells * most // 4, cells * most // 2, cells * most]
            enough = [each for each in classes if each >= request.count]
            if enough and size >= request.least_bytes:
                copies = min(int(MAX_COPIES * request.count), enough[0] - request.count)
                return RecordPlan(size, copies, cells)
        return None

    def _fit_as_alone(self, plans: Sequence[RecordPlan], requests: Sequence[RecordRequest]) -> bool:
        """Records that divide carriers come first, anywhere; then the others on carriers left untouched."""
        divided = [plan.cells_per_carrier for plan in plans if plan.cells_per_carrier > 1]
        if len(requests) > UNNOTICED or len(set(divided)) > 1:
            return False
        carriers, cells = self.carriers - self._set_aside, max(divided, default=1)
        whole = shared = 0
        for plan, request in zip(plans, requests, strict=True):
            if plan.cells_per_carrier == 1:
                whole += request.count + plan.copies
            else:
                shared += request.count + plan.copies
        if shared > cells * carriers or not whole:
            return shared <= cells * carriers
        untouched = (1 - shared / (cells * carriers)) ** cells
        fewest = carriers * untouched - _DEVIATIONS * (carriers * untouched * (1 - untouched)) ** 0.5
        return bool(whole <= fewest)

    def _tight(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """All that there is for these secrets: whole carriers, then fewer copies, then smaller cells."""
        left = self.carriers - self._headers(requests)
        for cells in range(1, MAX_CELLS + 1):
            size = self.record_bytes(cells)
            if size < max(request.least_bytes for request in requests):
                break
            count = sum(request.count for request in requests)
            if count <= cells * left:
                spare = (cells * left - count) / max(1, count)
                copies = min(MAX_COPIES, spare)
                return [RecordPlan(size, int(copies * request.count), cells) for request in requests]
        raise UsageError(
            f"{sum(request.count for request in requests):,} Gaussians are too many for this cover: "
            f"{self.carriers:,} of its Gaussians can carry something, and "
            f"{self.record_capacity(requests):,} would fit"
        )


def payload_parts(alone: Sequence[int]) -> tuple[list[int], bool]:
    """Into how many parts the carriers are divided for each payload, and whether all is as if it were alone.

    `alone`: for each what would be enough for it, 4 or 2 parts. Where that is too much for all of them, each
    gets the same: the power of two from the number of payloads on, at least 2.
    """
    if sum(1 / parts for parts in alone) <= 1:
        return list(alone), True
    return [shares(len(alone))] * len(alone), False


def shares(secrets: int) -> int:
    """Into how many parts payloads divide the carriers at most."""
    return max(2, 1 << (secrets - 1).bit_length())
