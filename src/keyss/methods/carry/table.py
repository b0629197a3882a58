"""How many bits which attribute gets, for records of any size."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

MOST_BITS = 24  # of one number: float32 has no more
CHROMA_FEWER = 2  # bits
BANDS = (3, 5, 7)  # spherical harmonics of degrees 1, 2, 3; each of three colours

# Bits with which an attribute alone costs 60 dB against the unquantised model: measured on models of bonsai
# and fox (200 px, 20,000 Gaussians). One bit more or less is 6 dB. Spherical harmonics are given 0.8 more
# than that, and never so few that highlights come out too weak, which photos notice.
_BITS_FOR_60_DB = (15.5, 8.8, 8.2, 7.2, 8.2, 5.2, 5.4, 5.4)
_NUMBERS = (3, 3, 3, 1, 3, 3 * BANDS[0], 3 * BANDS[1], 3 * BANDS[2])
_FLOOR = (15, 8, 8, 7, 8, 4, 4, 4)


@dataclass(frozen=True)
class Table:
    """Bits of one number of each attribute; 0 for a band of spherical harmonics that is not there.

    Of colours and harmonics these are the bits of the brightness; the two differences of colours have two
    fewer, for they are a tenth of the energy.
    """

    means: int
    log_scales: int
    quats: int
    opacity: int
    dc: int
    sh1: int
    sh2: int
    sh3: int

    def __post_init__(self) -> None:
        """Raise ValueError for what no table is."""
        bits = astuple(self)
        if not (all(1 <= b <= MOST_BITS for b in bits[:5]) and all(0 <= b <= MOST_BITS for b in bits[5:])):
            raise ValueError(f"bits out of range: {self}")
        if min(bits for bits in astuple(self)[4:] if bits) <= CHROMA_FEWER:
            raise ValueError(f"no bits are left for differences of colours: {self}")
        if (self.sh2 and not self.sh1) or (self.sh3 and not self.sh2):
            raise ValueError(f"a band of spherical harmonics is missing below another: {self}")

    @staticmethod
    def floor(sh_degree: int) -> Table:
        """The smallest table in use: about 50 dB against the unquantised model."""
        return Table(*_FLOOR[: 5 + sh_degree], *[0] * (3 - sh_degree))

    @staticmethod
    def of_size(bits: int, sh_degree: int) -> Table | None:
        """The table for records of at most `bits` that distorts least; None if not even the floor fits.

        Bits are given one by one to the attribute for which one more takes away the most error per bit.
        """
        table = Table.floor(sh_degree)
        if table.total > bits:
            return None
        while True:
            given = astuple(table)
            room = bits - table.total
            grow = [
                index
                for index in range(5 + sh_degree)
                if _NUMBERS[index] <= room and given[index] < MOST_BITS
            ]
            if not grow:
                return table
            best = max(grow, key=lambda i: 4 ** (_BITS_FOR_60_DB[i] - given[i]) / _NUMBERS[i])
            name = list(table.__dataclass_fields__)[best]
            table = replace(table, **{name: given[best] + 1})

    @property
    def sh_degree(self) -> int:
        return sum(bits > 0 for bits in (self.sh1, self.sh2, self.sh3))

    @property
    def bands(self) -> tuple[int, ...]:
        """Bits of a coefficient for each band that is there."""
        return (self.sh1, self.sh2, self.sh3)[: self.sh_degree]

    @property
    def total(self) -> int:
        """Bits of a record."""
        bits: tuple[int, ...] = astuple(self)
        colours = 1 + sum(BANDS[: self.sh_degree])
        return (
            2
            + sum(each * numbers for each, numbers in zip(bits, _NUMBERS, strict=True))
            - 2 * CHROMA_FEWER * colours
        )
