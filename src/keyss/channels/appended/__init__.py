"""Bytes in Gaussians that are appended to a model, too faint and too small to be seen.

They survive every format that people publish in, and moving, turning and scaling of the whole model. That
they are there is in plain sight; what they say takes the key.
"""
