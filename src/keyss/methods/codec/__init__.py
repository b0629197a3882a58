"""A model as bytes: quantised, sorted and entropy-coded; the precision that fits into a given size."""
