"""Colours of Gaussians, changed so little that they survive rounding: bytes that survive other formats."""
