"""Formats that models are published in, one module each.

Those that round have two levels: `parse` and `serialise` between bytes and codes, the integers of the file,
which invert each other exactly; `dequantise` and `quantise` between codes and `Gaussians`.
"""
