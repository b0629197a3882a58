"""The peers: published methods and simple baselines behind one protocol, to compare with (docs/peers.md).

They are written from the papers' descriptions and contain nobody else's code.
"""
