"""From a trained model to what is published, and to what its keys open.

After a warm start no Gaussian is shared: the cover has its own, and each secret has. Where the published file
keeps every bit, the secrets' are taken out and written as records into the low bits of the cover's. Then
every published Gaussian is one of the cover's, and there is nothing to be seen but an ordinary model.

Files that will be rounded keep no low bits. For them (`sidecar`) the secrets' Gaussians stay in the model as
transparent ones, and what finds them is encrypted beside it. The paper's start from points shares Gaussians
between scenes, and what its key opens is a decoder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from keyss.channels.base import Payload
from keyss.channels.low_bits import LOW_BITS, LowBitsCover
from keyss.channels.sidecar import encrypt_sidecar
from keyss.core.errors import InputError, KeyssError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.fitting.plain import without_faint
from keyss.keys.derivation import expand, stream
from keyss.methods.base import Opened
from keyss.methods.dither import dither
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.payload import HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.room import record_degree
from keyss.methods.records.embedding import embed_models
from keyss.methods.records.encoding import subsampled_counts

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
    """What is published of a finished run. Raises UsageError for a model too small for its secrets."""
    if options.in_records:
        return _in_records(run, keys, frames, options, discarded)
    return _with_decoders(run, keys, frames, options, discarded)


def _in_records(
    run: JointRun,
    keys: Sequence[str],
    frames: Sequence[Similarity],
    options: LearnedOptions,
    discarded: bytes,
) -> Published:
    """The cover's Gaussians in the order of its plain model, with the secrets' in their low bits."""
    cover, secrets = run.separated()
    cover = without_faint(cover.to("cpu"), options.fit.prune_opacity)
    degree = record_degree(cover.sh_degree)
    if degree is None:
        raise ValueError(f"a model of SH degree {cover.sh_degree} has no room for records")
    models = [
        frame.inverse().apply_gaussians(secret.to("cpu")).with_sh_degree(degree)
        for secret, frame in zip(secrets, frames, strict=True)
    ]
    prepared = _prepared(cover, discarded)
    counts = subsampled_counts(prepared, models)
    found = embed_models(prepared, keys, models, counts, NAME, entropy=discarded)
    return Published(found.stego, None, found.opened, found.details(cover))


def _prepared(cover: Gaussians, entropy: bytes) -> LowBitsCover:
    """With new low bits where those of the trained model are not random."""
    try:
        return LOW_BITS.prepare(cover)
    except InputError:
        return LOW_BITS.prepare(dither(cover, expand(entropy, "dither", 32)))


def _with_decoders(
    run: JointRun,
    keys: Sequence[str],
    frames: Sequence[Similarity],
    options: LearnedOptions,
    discarded: bytes,
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
