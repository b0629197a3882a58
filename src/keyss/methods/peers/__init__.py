"""The peers: what others have published, and the simplest things that could be done, behind one protocol.

Written from the papers' descriptions, to be compared with (docs/peers.md); nobody's code is in them.
"""

from keyss.methods.peers.bound import BoundMethod
from keyss.methods.peers.decoder import DecoderMethod
from keyss.methods.peers.gs_hider import GsHiderMethod
from keyss.methods.peers.sh import ShMethod
from keyss.methods.peers.watergs import WaterGsMethod

PEERS = (BoundMethod(), ShMethod(), DecoderMethod(), GsHiderMethod(), WaterGsMethod())
