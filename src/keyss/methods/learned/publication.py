"""From a jointly trained model to what is published, and to what its keys open.

After a warm start (`sidecar`) the secrets' Gaussians lie in the model as transparent ones, and what finds
them is encrypted beside it. The paper's start from points shares Gaussians between scenes. In both cases a
key opens a decoder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from keyss.channels.base import Payload
from keyss.channels.low_bits import LOW_BITS
from keyss.channels.sidecar import encrypt_sidecar
from keyss.core.errors import KeyssError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import stream
from keyss.methods.base import Opened
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.payload import HiddenSecret, choose_anchors, pack_secret, unpack_secret

NAME = "learned"


@dataclass(frozen=True)
class Published:
    """A published model and what it takes to open its secrets."""

    stego: Gaussians
    sidecar: bytes | None
    opened: tuple[Opened, ...]
    details: dict[str, Any] = field(default_factory=dict)


def publish(
    run: JointRun,
    keys: Sequence[str],
    frames: Sequence[Similarity],  # of the secrets
    options: LearnedOptions,
    discarded: bytes,  # 32 bytes that nobody else knows
) -> Published:
    """All Gaussians that any scene draws, in a random order, and for each key the decoder of its secret.

    Training has the cover's Gaussians first and the secrets' after them, in the order of their plain models.
    """
    stego = run.gaussians().to("cpu")
    if run.warm:
        stego = stego[run.drawn().cpu()]
    numbers = np.frombuffer(stream(discarded, "order", 8 * len(stego)), "<u8")
    stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
    anchors = choose_anchors(stego, torch.Generator().manual_seed(options.fit.known_seed))
    transparent = stego[stego.opacities < DRAWN_OPACITY]
    faint = None
    if options.sidecar and len(transparent):
        columns = [transparent.means, transparent.opacity_logits[:, None], transparent.sh[:, 0]]
        faint = torch.cat(columns, dim=1)
    packed = []
    for decoder, frame in zip(run.decoders, frames, strict=True):
        secret = HiddenSecret(decoder.to("cpu").requires_grad_(False), frame, anchors, faint)
        drawn = secret.decode(stego, secret.embedding).opacities >= DRAWN_OPACITY
        packed.append(pack_secret(replace(secret, count=int(drawn.sum()))))
    payloads = [(key, Payload(NAME, data)) for key, data in zip(keys, packed, strict=True)]
    opened = tuple(map(unpack_secret, packed))
    if options.sidecar:
        return Published(stego, encrypt_sidecar(payloads, entropy=discarded), opened)
    try:
        return Published(LOW_BITS.prepare(stego).embed(payloads, entropy=discarded), None, opened)
    except KeyssError as error:  # not known before; the training is not lost
        sidecar = encrypt_sidecar(payloads, entropy=discarded)
        return Published(stego, sidecar, opened, {"sidecar_because": str(error)})
