"""The low mantissa bits of a float model: exact, and lost in every format that rounds."""

from keyss.channels.low_bits.channel import LOW_BITS, LowBits, LowBitsCover
from keyss.channels.low_bits.reading import LowBitsReader

__all__ = ["LOW_BITS", "LowBits", "LowBitsCover", "LowBitsReader"]
