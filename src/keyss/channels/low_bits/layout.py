"""Which carriers hold what: headers, the shares of payloads, and how many records divide a carrier.

Every secret has a *header* in a few whole carriers: its data key for each salt, and parameters that tell how
the rest is read. After it come a payload's chunks, or records.

A *payload* gets an equal share of the carriers: one in two, one in four where there are three or four
secrets, and so on. What it does not need becomes redundancy, so that the number of its cells tells nothing.

*Records* have carriers of their own, one record each, if records and header take no more than half of all. A
larger secret divides every carrier into halves (or thirds, quarters) for smaller records. Up to a quarter
of the records, those whose loss costs most, are embedded twice: a copy of 10 % takes away half of what
random pruning costs. All this follows from a secret's own size, not from what else is hidden; only if the
secrets do not fit together so, all do without copies or get smaller cells.
"""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels.base import RecordPlan, RecordRequest
from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.cells import TAG_BYTES
from keyss.core.errors import UsageError

DATA_KEY_BYTES = 16
SALTS = 12  # Gaussians that may serve as the salt: random pruning of a quarter removes all with p = 6e-8
KEY_COPIES = 12  # of the data key, for each salt
PARAMETER_COPIES = 24  # of each part: all are removed with a quarter of the model with p = 4e-15
PREFIX_BYTES = 32  # at most, of the parameters before a method's own header (see `parameters`)
MOST_CELLS = 4  # of a carrier
MOST_COPIES = 0.25  # of a secret's records


def shares(secrets: int) -> int:
    """Into how many parts payloads divide the carriers: the power of two from `secrets` on, at least 2."""
    return max(2, 1 << (secrets - 1).bit_length())


def part_bytes(sh_degree: int) -> int:
    """Bytes of parameters in one cell, beside its tag and its number; not above 0 where nothing fits."""
    width = bytes_per_gaussian(sh_degree)
    return width - TAG_BYTES - 1 if width >= TAG_BYTES + DATA_KEY_BYTES else 0


def header_carriers(sh_degree: int, header_bytes: int) -> int:
    """Carriers that a secret's header takes; `header_bytes`: what the method adds to the parameters."""
    parts = -(-(PREFIX_BYTES + header_bytes) // max(1, part_bytes(sh_degree)))
    return SALTS * KEY_COPIES + parts * PARAMETER_COPIES


def record_bytes(sh_degree: int, cells: int) -> int:
    """Bytes of a record where `cells` of them divide a carrier; 0 where nothing fits."""
    return max(0, bytes_per_gaussian(sh_degree) // cells - TAG_BYTES) if part_bytes(sh_degree) else 0


def plan_records(requests: Sequence[RecordRequest], carriers: int, sh_degree: int) -> list[RecordPlan]:
    """A plan for each of the requests; those with more than one cell of a carrier have equally many.

    `carriers`, `sh_degree`: of the cover. Raises UsageError with the number of records that fits.
    """
    least, most = max(request.least_bytes for request in requests), record_bytes(sh_degree, 1)
    if least > most:
        raise UsageError(
            f"a Gaussian of SH degree {sh_degree} has room for records of {most} bytes, and at least {least} "
            "are needed"
        )
    own = [_own_cells(request, carriers, sh_degree) for request in requests]
    attempts = [[1 if cells == 1 else max(own) for cells in own]]
    attempts += [[cells] * len(requests) for cells in (*range(2, MOST_CELLS + 1), 1)]
    for cells in attempts:
        wanted = [_copies(*pair, carriers, sh_degree) for pair in zip(requests, cells, strict=True)]
        fewer = [copies if each == 1 else 0 for copies, each in zip(wanted, cells, strict=True)]
        for copies in (wanted, fewer, [0] * len(requests)):
            plans = [
                RecordPlan(record_bytes(sh_degree, each), more, each)
                for each, more in zip(cells, copies, strict=True)
            ]
            if _fit(plans, requests, carriers, sh_degree):
                return plans
    raise UsageError(
        f"{sum(request.count for request in requests):,} Gaussians are too many for this cover: "
        f"{carriers:,} of its Gaussians can carry something, and "
        f"{record_capacity(requests, carriers, sh_degree):,} would fit"
    )


def record_capacity(requests: Sequence[RecordRequest], carriers: int, sh_degree: int) -> int:
    """Records of the smallest useful size that fit for all requests together; 0 if none."""
    left = carriers - sum(header_carriers(sh_degree, request.header_bytes) for request in requests)
    least = max(request.least_bytes for request in requests)
    cells = [each for each in range(1, MOST_CELLS + 1) if record_bytes(sh_degree, each) >= least]
    return max(0, left) * max(cells, default=0)


def _own_cells(request: RecordRequest, carriers: int, sh_degree: int) -> int:
    """Cells of a carrier that suit a secret for itself."""
    header = header_carriers(sh_degree, request.header_bytes)
    if request.count + header <= carriers // 2:
        return 1
    enough = (cells for cells in range(2, MOST_CELLS + 1) if request.count <= cells * (carriers - header))
    return next(enough, MOST_CELLS)


def _copies(request: RecordRequest, cells: int, carriers: int, sh_degree: int) -> int:
    """Copies that suit a secret for itself: one with whole carriers keeps to half of all."""
    most = int(MOST_COPIES * request.count)
    if cells > 1:
        return most
    left = carriers // 2 - header_carriers(sh_degree, request.header_bytes) - request.count
    return max(0, min(most, left))


def _fit(
    plans: Sequence[RecordPlan], requests: Sequence[RecordRequest], carriers: int, sh_degree: int
) -> bool:
    taken = shared = 0
    for plan, request in zip(plans, requests, strict=True):
        if plan.record_bytes < request.least_bytes:
            return False
        taken += header_carriers(sh_degree, request.header_bytes)
        if plan.cells_per_carrier == 1:
            taken += request.count + plan.copies
        else:
            shared += request.count + plan.copies
    return taken + -(-shared // max(plan.cells_per_carrier for plan in plans)) <= carriers
