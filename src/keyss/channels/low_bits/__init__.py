"""The low mantissa bits of a float model: exact, and lost in every format that rounds."""
