"""How many bits which attribute gets, for records of any size."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

MOST_BITS = 24  # of one number: float32 has no more
BANDS = (3, 5, 7)  # spherical harmonics of degrees 1, 2, 3; each of three colours

# Bits with which an attribute alone costs 60 dB against the unquantised model: measured on models of bonsai
# and fox (200 px, 20,000 Gaussians). One bit more or less is 6 dB. Spherical harmonics are given 0.8 more
# than that and never fewer than 3: with 2, highlights come out too weak, which photos notice (0.1 dB).
_BITS_FOR_60_DB = (15.5, 8.8, 8.2, 7.2, 7.2, 3.6, 3.8, 3.8)
_NUMBERS = (3, 3, 3, 1, 3, 3 * BANDS[0], 3 * BANDS[1], 3 * BANDS[2])
_FLOOR = (15, 8, 8, 7, 7, 3, 3, 3)


@dataclass(frozen=True)
class Table:
    """Bits of one number of each attribute; 0 for a band of spherical harmonics that is not there."""

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
        return 2 + sum(each * numbers for each, numbers in zip(bits, _NUMBERS, strict=True))
