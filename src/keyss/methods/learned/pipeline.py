"""How the learned method hides: one frame for all scenes, joint training, encryption."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import torch
from torch import Tensor

from keyss.channels.base import Payload
from keyss.channels.low_bits import LOW_BITS
from keyss.channels.low_bits.spread import check_payload_fits
from keyss.channels.sidecar import encrypt_sidecar
from keyss.core.alignment import align
from keyss.core.errors import KeyssError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.loop import train
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.methods.base import Context, KeyedSource, Source, Stego, advising
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.joint import JointRun, decoder_shape
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.payload import ANCHORS, HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.rank_shift import (
    CHANNELS,
    KEY_BYTES,
    KNOTS,
    RankShift,
    match_quaternion_lengths,
)
from keyss.methods.learned.revealing import OpenedSecret, decode, is_drawn
from keyss.methods.learned.targets import PlacedScene

NAME = "learned"
SIDECAR_ADVICE = "--sidecar writes a file beside it instead"


def hide(cover: Source, secrets: Sequence[KeyedSource], options: LearnedOptions, context: Context) -> Stego:
    """Hide `secrets` in `cover`, each to be opened by its key; see `keyss.methods.base.Method`.

    Raises UsageError for a model too small for what it has to carry, Interrupted on Ctrl-C, and InputError
    for a checkpoint of another run.
    """
    options = training_options(options)
    sources, keys = [cover, *(each.source for each in secrets)], [each.key for each in secrets]
    models = [source.model.with_sh_degree(options.fit.sh_degree) for source in sources]
    scenes = [source.scene for source in sources]
    derivation = KeyDerivation(salt=training_salt(cover.scene, options.fit.seed))
    derived = [DerivedKey(key, derivation) for key in keys]
    encoder = encoder_of(options)
    embeddings = [key.embedding() for key in derived] if encoder is None else [encoder(key) for key in keys]

    cover_cameras = [view.camera for view in scenes[0].train]
    frames = [Similarity.identity()]
    frames += [align([view.camera for view in scene.train], cover_cameras) for scene in scenes[1:]]
    placed = [PlacedScene.of(*parts) for parts in zip(scenes, models, frames, strict=True)]
    run = JointRun(placed, embeddings, options, context.device)
    seconds = train(
        run,
        "hide",
        fingerprint={
            "scenes": [scene.digest() for scene in scenes],
            "models": [hashlib.sha256(model.means.numpy().tobytes()).hexdigest() for model in models],
            "keys": [
                hashlib.sha256(key.verifier() + embedding.numpy().tobytes()).hexdigest()
                for key, embedding in zip(derived, embeddings, strict=True)
            ],
            "options": json.loads(json.dumps(asdict(options))),  # tuples as they are read back
            "device": context.device.type,
        },
        seed=options.fit.seed,
        checkpoint=context.checkpoints / "joint.safetensors" if context.checkpoints else None,
        resume=context.resume,
        checkpoint_seconds=options.fit.checkpoint_seconds,
        evaluate_every=options.fit.evaluate_every,
        reporter=context.reporter,
    )
    stego = run.gaussians().to("cpu")
    decoders = [decoder.to("cpu").requires_grad_(False) for decoder in run.decoders]
    if run.warm:
        stego = stego[run.drawn().cpu()]
    rank_shifts: list[RankShift | None] = [None] * len(keys)
    # A sidecar is for files that will be rounded, and no keyed rank shift survives rounding.
    if run.warm and not options.sidecar:
        for index, (key, decoder) in enumerate(zip(derived, decoders, strict=True)):
            if options.decoder == "remap":  # a network would see the difference
                stego = match_quaternion_lengths(stego, decoder.band.outer)
            rank_shift = RankShift.of(stego, key.expand("rank-shift", KEY_BYTES), decoder.band.outer)
            stego, rank_shifts[index] = rank_shift.encrypt(stego), rank_shift
    anchors = choose_anchors(stego, torch.Generator().manual_seed(options.fit.seed))
    transparent = stego[~is_drawn(stego)]
    faint = None
    if options.sidecar and len(transparent):
        columns = [transparent.means, transparent.opacity_logits[:, None], transparent.sh[:, 0]]
        faint = torch.cat(columns, dim=1)
    hidden = [
        HiddenSecret(decoder, frame, anchors, rank_shift, faint)
        for decoder, frame, rank_shift in zip(decoders, frames[1:], rank_shifts, strict=True)
    ]
    counts = [int(is_drawn(decode(stego, secret, secret.embedding)).sum()) for secret in hidden]
    packed = [pack_secret(replace(secret, count=count)) for secret, count in zip(hidden, counts, strict=True)]
    payloads = [(key, Payload(NAME, data)) for key, data in zip(keys, packed, strict=True)]
    sidecar, entropy = None, _discarded(run, derived)
    if options.sidecar:
        sidecar = encrypt_sidecar(payloads, entropy=entropy)
    else:
        with advising(KeyssError, SIDECAR_ADVICE):
            stego = LOW_BITS.prepare(stego).embed(payloads, entropy=entropy)
    opened = tuple(OpenedSecret(unpack_secret(each)) for each in packed)
    return Stego(stego, sidecar, opened, seconds, options.fit.iterations)


def training_options(options: LearnedOptions) -> LearnedOptions:
    """`options` whose `fit` is that of the joint training."""
    iterations = options.iterations or options.fit.iterations
    cap = options.max_gaussians or options.fit.max_gaussians
    return replace(options, fit=replace(options.fit, iterations=iterations, max_gaussians=cap))


def encoder_of(options: LearnedOptions) -> Callable[[str], Tensor] | None:
    """From a key to the embedding [64] that conditions its decoder; None: Argon2id's. Raises BackendError."""
    if options.key_encoder == "argon2":
        return None
    from keyss.methods.learned.clip_keys import MODEL, ClipKeys

    return ClipKeys(options.clip_model or MODEL)


def check_room(options: LearnedOptions, models: Sequence[Gaussians | None]) -> None:
    """Raise UsageError if what keys open will hardly fit into the model that is to be trained.

    `models`: of the cover and of the secrets, those that are known. A warm start from them adds no Gaussians.
    """
    options = training_options(options)
    gaussians, known = options.fit.max_gaussians, [model for model in models if model is not None]
    if options.start == "warm" and len(known) == len(models):
        gaussians = min(gaussians, sum(len(model) for model in known))
    with advising(UsageError, SIDECAR_ADVICE):
        check_payload_fits(_largest_payload(options), gaussians, len(models) - 1, options.fit.sh_degree)


def _largest_payload(options: LearnedOptions) -> int:
    """Bytes of a secret whose decoder cannot be compressed."""
    decoder = Decoder(decoder_shape(options))
    rank_shift = None
    if options.start == "warm":
        tables = torch.rand(2, CHANNELS, KNOTS)
        rank_shift = RankShift(bytes(KEY_BYTES), (0.0, 1.0), tables[0], tables[1])
    secret = HiddenSecret(decoder, Similarity.identity(), torch.rand(ANCHORS, 3), rank_shift)
    return len(pack_secret(secret))


def _discarded(run: JointRun, keys: Sequence[DerivedKey]) -> bytes:
    """32 bytes that only who trained with these keys can know: the optimiser's state is thrown away."""
    tensors, _ = run.state()
    state = hashlib.sha256(b"keyss/v1/discarded" + b"".join(key.expand("writer", 32) for key in keys))
    for name in sorted(tensors):
        state.update(tensors[name].cpu().contiguous().numpy().tobytes())
    return state.digest()


def training_salt(cover: Scene, seed: int) -> bytes:
    """A salt that is the same when a run is repeated and differs between covers and between seeds.

    A salt must be unique rather than secret; taking it from public things makes runs repeatable.
    """
    return hashlib.sha256(f"keyss/v1/salt {seed} {cover.digest()}".encode()).digest()[:SALT_BYTES]
