"""Published methods and simple baselines behind one protocol, to compare with (docs/baselines.md).

They are written from the papers' descriptions and contain nobody else's code.
"""
