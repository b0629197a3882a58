"""Which Gaussians of a cover carry what: how many cells each is divided into, and what does not fit.

Every usable Gaussian of the cover is a *carrier*. A *header* takes a few whole ones. A secret whose records
and header take no more than half of the carriers gets whole ones, one record each; one that is larger gets
halves (or thirds, quarters), of coarser records, on different carriers as far as there are enough. The
most visible Gaussians, up to a quarter of all, are there twice, for they are what random pruning costs most
by: a copy of 10 % takes away half of that cost. All this follows from the secret's own size, not from what
else is hidden; only if the secrets do not fit together so, all do without copies or get smaller cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.byte_plan import COPIES, SALTS
from keyss.channels.low_bits.cells import TAG_BYTES
from keyss.core.errors import UsageError
from keyss.methods.carry.quantise import Codec
from keyss.methods.carry.table import Table

DATA_KEY_BYTES = 16
PARAMETER_COPIES = 24  # of every part: all are removed with a quarter of the model with probability 4e-15
PREFIX_BYTES = 6  # of the parameters before the codec: version, cells of a carrier, number of Gaussians
MOST_CELLS = 4  # of a carrier
MOST_COPIES = 0.25  # of a secret's Gaussians


@dataclass(frozen=True)
class Size:
    """What is asked for: a secret of `count` Gaussians."""

    count: int
    sh_degree: int


@dataclass(frozen=True)
class Layout:
    """How one secret lies in the carriers: records by `table`, `cells` of them in a carrier."""

    cells: int
    table: Table
    copies: int  # of its most visible Gaussians


def plan(sizes: Sequence[Size], carriers: int, gaussians: int, cover_degree: int) -> list[Layout]:
    """A layout for each of the secrets; those with more than one cell of a carrier have equally many.

    `gaussians`: of the cover, of which `carriers` can be used. Raises UsageError with the number that fits.
    """
    own = [_own_choice(size, carriers, cover_degree) for size in sizes]
    largest = max(own)
    attempts = [[1 if d == 1 else largest for d in own]]
    attempts += [[d] * len(sizes) for d in (*range(2, MOST_CELLS + 1), 1)]
    for cells in attempts:
        wanted = [_copies(size, d, carriers, cover_degree) for size, d in zip(sizes, cells, strict=True)]
        fewer = [more if d == 1 else 0 for more, d in zip(wanted, cells, strict=True)]
        for copies in (wanted, fewer, [0] * len(sizes)):
            layouts = _layouts(sizes, cells, copies, cover_degree)
            if layouts is not None and _fits(layouts, sizes, carriers, cover_degree):
                return layouts
    raise UsageError(_too_large(sizes, carriers, gaussians, cover_degree))


def check_degrees(sizes: Sequence[Size], cover_degree: int) -> None:
    """Raise UsageError if not even one record of these secrets fits into a Gaussian of such a cover."""
    degree = max(size.sh_degree for size in sizes)
    if _table(cover_degree, 1, degree) is None:
        raise UsageError(
            f"a cover of SH degree {cover_degree} cannot carry a secret of SH degree {degree}: one of its "
            f"Gaussians has room for {bytes_per_gaussian(cover_degree)} bytes, and a record takes at least "
            f"{TAG_BYTES + -(-Table.floor(degree).total // 8)}; --method learned can hide it"
        )


def room(sizes: Sequence[Size], carriers: int, cover_degree: int) -> int:
    """Gaussians that fit for all of the secrets together, if they are thinned; 0 if none."""
    left = carriers - sum(header_carriers(cover_degree, size.sh_degree) for size in sizes)
    possible = [
        d
        for d in range(1, MOST_CELLS + 1)
        if all(_table(cover_degree, d, size.sh_degree) is not None for size in sizes)
    ]
    return max(0, left) * max(possible, default=0)


def thinned(sizes: Sequence[Size], carriers: int, cover_degree: int) -> list[int]:
    """How many Gaussians of each secret are kept so that all fit: the largest secrets give first.

    Raises UsageError if nothing fits at all.
    """
    most = room(sizes, carriers, cover_degree)
    if most < len(sizes):
        raise UsageError(_too_large(sizes, carriers, carriers, cover_degree))
    counts: dict[int, int] = {}
    left = most
    for index in sorted(range(len(sizes)), key=lambda i: sizes[i].count):
        counts[index] = min(sizes[index].count, left // (len(sizes) - len(counts)))
        left -= counts[index]
    return [counts[index] for index in range(len(sizes))]


def header_carriers(cover_degree: int, secret_degree: int) -> int:
    """Carriers that a secret's header takes: 216 where both SH degrees are 3."""
    return SALTS * COPIES + parameter_parts(cover_degree, secret_degree) * PARAMETER_COPIES


def parameter_parts(cover_degree: int, secret_degree: int) -> int:
    """Cells that one copy of the parameters takes."""
    return -(-(PREFIX_BYTES + Codec.packed_size(secret_degree)) // max(1, part_bytes(cover_degree)))


def part_bytes(cover_degree: int) -> int:
    """Bytes of parameters in one cell, beside its tag and its number."""
    return bytes_per_gaussian(cover_degree) - TAG_BYTES - 1


def _own_choice(size: Size, carriers: int, cover_degree: int) -> int:
    """Cells of a carrier that suit a secret for itself."""
    header = header_carriers(cover_degree, size.sh_degree)
    if size.count + header <= carriers // 2:
        return 1
    enough = (d for d in range(2, MOST_CELLS + 1) if size.count <= d * (carriers - header))
    return next(enough, MOST_CELLS)


def _copies(size: Size, cells: int, carriers: int, cover_degree: int) -> int:
    """Copies that suit a secret for itself: those with whole carriers keep to half of all."""
    most = int(MOST_COPIES * size.count)
    if cells > 1:
        return most
    left = carriers // 2 - header_carriers(cover_degree, size.sh_degree) - size.count
    return max(0, min(most, left))


def _layouts(
    sizes: Sequence[Size], cells: Sequence[int], copies: Sequence[int], cover_degree: int
) -> list[Layout] | None:
    """None if one of the cells is too small."""
    result = []
    for size, d, more in zip(sizes, cells, copies, strict=True):
        table = _table(cover_degree, d, size.sh_degree)
        if table is None:
            return None
        result.append(Layout(d, table, more))
    return result


def _fits(layouts: Sequence[Layout], sizes: Sequence[Size], carriers: int, cover_degree: int) -> bool:
    taken, shared = 0, 0
    for layout, size in zip(layouts, sizes, strict=True):
        taken += header_carriers(cover_degree, size.sh_degree)
        records = size.count + layout.copies
        if layout.cells == 1:
            taken += records
        else:
            shared += records
    return taken + -(-shared // max(layout.cells for layout in layouts)) <= carriers


def _table(cover_degree: int, cells: int, secret_degree: int) -> Table | None:
    width = bytes_per_gaussian(cover_degree)
    if width < TAG_BYTES + DATA_KEY_BYTES:
        return None
    return Table.of_size(8 * (width // cells - TAG_BYTES), secret_degree)


def _too_large(sizes: Sequence[Size], carriers: int, gaussians: int, cover_degree: int) -> str:
    asked = sum(size.count for size in sizes)
    what = "a secret" if len(sizes) == 1 else f"{len(sizes)} secrets"
    return (
        f"{what} of {asked:,} Gaussians is too large for this cover: {carriers:,} of its {gaussians:,} "
        f"Gaussians can carry something, and {room(sizes, carriers, cover_degree):,} would fit; --thin "
        "leaves out the least visible"
    )
