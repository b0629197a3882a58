"""Bytes in Gaussians that are appended to a model, too faint and too small to be seen.

They survive every format that people publish in, and moving, turning and scaling of the whole model. That
they are there is in plain sight; what they say takes the key.
"""

from keyss.channels.appended.channel import MOST_BYTES as MOST_BYTES
from keyss.channels.appended.channel import AppendedReader as AppendedReader
from keyss.channels.appended.channel import appended_for as appended_for
from keyss.channels.appended.channel import embed as embed
from keyss.channels.appended.lattice import is_appended as is_appended

__all__ = ["MOST_BYTES", "AppendedReader", "appended_for", "embed", "is_appended"]
