"""Formats of published models, one module each.

Lossy formats have two levels: `parse` and `serialise` convert between bytes and codes, the integers of the
file, exactly; `dequantise` and `quantise` between codes and `Gaussians`.
"""
