"""Tables of the bits of each attribute, for records of any size."""

from __future__ import annotations

from dataclasses import dataclass

MAX_BITS = 24  # of one number: float32 has no more
CHROMA_FEWER = 2  # bits
BANDS = (1, 3, 5, 7)  # spherical harmonics of degrees 0 to 3; each of three colours

# Bits with which quantising an attribute alone leaves 60 dB to the unquantised model, measured on models of
# bonsai and fox (200 px, 20,000 Gaussians). One bit more or less is 6 dB. Spherical harmonics get 0.8 more,
# and at least as many as highlights need, which PSNR against photos shows.
_BITS_FOR_60_DB = (15.5, 8.8, 8.2, 7.2, 8.2, 5.2, 5.4, 5.4)
_NUMBERS = (3, 3, 3, 1, *(3 * count for count in BANDS))
_FLOOR = (15, 8, 8, 7, 8, 4, 4, 4)


@dataclass(frozen=True)
class Table:
    """Bits of one number of positions, log scales, quaternions and opacity, then of each band of harmonics.

    For harmonics, the constant ones included, these are the bits of the brightness; the two differences of
    colours, which have a tenth of the energy, get two fewer. Raises ValueError for bits out of range.
    """

    bits: tuple[int, ...]

    def __post_init__(self) -> None:
        if not 5 <= len(self.bits) <= 8 or not all(1 <= each <= MAX_BITS for each in self.bits):
            raise ValueError(f"bits out of range: {self}")
        if min(self.bits[4:]) <= CHROMA_FEWER:
            raise ValueError(f"no bits are left for differences of colours: {self}")

    @staticmethod
    def floor(sh_degree: int) -> Table:
        """The smallest table in use: about 50 dB against the unquantised model."""
        return Table(_FLOOR[: 5 + sh_degree])

    @staticmethod
    def short() -> Table:
        """A still smaller table of SH degree 0, for payloads: about 40 dB."""
        return Table(tuple(each - 2 for each in _FLOOR[:5]))

    @staticmethod
    def of_size(bits: int, sh_degree: int, start: Table | None = None) -> Table | None:
        """The table for records of at most `bits` with the least error; None if `start` does not fit.

        `start`: by default the floor. Each further bit goes to the attribute that it takes the most error
        from.
        """
        table = start or Table.floor(sh_degree)
        while (room := bits - table.total) >= 0:
            given = table.bits
            grow = [i for i, each in enumerate(given) if _NUMBERS[i] <= room and each < MAX_BITS]
            if not grow:
                return table
            best = max(grow, key=lambda i: 4 ** (_BITS_FOR_60_DB[i] - given[i]) / _NUMBERS[i])
            table = Table((*given[:best], given[best] + 1, *given[best + 1 :]))
        return None

    @property
    def sh_degree(self) -> int:
        return len(self.bits) - 5

    @property
    def total(self) -> int:
        """Bits of a record: its numbers, one for outliers, and two for the largest part of the quaternion."""
        numbers = sum(each * count for each, count in zip(self.bits, _NUMBERS, strict=False))
        return 3 + numbers - 2 * CHROMA_FEWER * sum(BANDS[: self.sh_degree + 1])

    @property
    def record_bytes(self) -> int:
        """Whole bytes of a record."""
        return -(-self.total // 8)

    @property
    def layout(self) -> list[tuple[int, int]]:
        """(columns, bits) of codes in the order of records: outlier, largest part of the quaternion, ..."""
        means, log_scales, quats, opacity, *colours = self.bits
        positions = [(1, means)] * 3
        layout = [(1, 1), (1, 2), (3, quats), *positions, (3, log_scales), (1, opacity)]
        for count, bits in zip(BANDS, colours, strict=False):
            layout += [(count, bits), (2 * count, bits - CHROMA_FEWER)]
        return layout
