"""From a model that was trained from points to what is published, and to what its keys open.

Such a model shares Gaussians between scenes, and a key opens a decoder.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from keyss.channels import appended
from keyss.channels.base import Payload
from keyss.channels.low_bits import LOW_BITS
from keyss.core.errors import KeyssError, KeyssWarning
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import stream
from keyss.methods.base import Opened
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.payload import HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.room import APPENDED

NAME = "learned"


@dataclass(frozen=True)
class Published:
    """A published model and what its keys open."""

    stego: Gaussians
    opened: tuple[Opened, ...]
    details: dict[str, Any] = field(default_factory=dict)


def publish(
    run: JointRun,
    keys: Sequence[str],
    frames: Sequence[Similarity],  # of the secrets
    options: LearnedOptions,
    discarded: bytes,  # 32 bytes that nobody else knows
) -> Published:
    """All Gaussians in a random order, and in them for each key the decoder of its secret.

    Training has the cover's points first and the secrets' after them. Warns (KeyssWarning) where the low bits
    have no room, so that the decoders lie in appended Gaussians.
    """
    stego = run.gaussians().to("cpu")
    numbers = np.frombuffer(stream(discarded, "order", 8 * len(stego)), "<u8")
    stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
    anchors = choose_anchors(stego, torch.Generator().manual_seed(options.fit.known_seed))
    packed = []
    for decoder, frame in zip(run.decoders, frames, strict=True):
        secret = HiddenSecret(decoder.to("cpu").requires_grad_(False), frame, anchors)
        drawn = secret.decode(stego, secret.embedding).opacities >= DRAWN_OPACITY
        packed.append(pack_secret(replace(secret, count=int(drawn.sum()))))
    payloads = [(key, Payload(NAME, data)) for key, data in zip(keys, packed, strict=True)]
    opened = tuple(map(unpack_secret, packed))
    try:
        return Published(LOW_BITS.prepare(stego).embed(payloads, entropy=discarded), opened)
    except KeyssError as error:
        found = appended.embed(stego, payloads, entropy=discarded)
        warnings.warn(f"{error}; {APPENDED}", KeyssWarning, stacklevel=2)
        return Published(found, opened, {"appended_because": str(error)})
