"""The low mantissa bits of a float model."""
