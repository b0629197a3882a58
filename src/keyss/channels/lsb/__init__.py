"""Bits that a model has beside what it shows: exact, and lost in every format that rounds them."""
