"""Hiding from posed photos: plain models of all scenes, one frame for all, joint training."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path

import torch
from torch import Tensor

from keyss.channels.low_bits.byte_plan import check_room
from keyss.channels.low_bits.container import embed
from keyss.channels.sidecar import seal_sidecar
from keyss.core.alignment import align
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.loop import Reporter, train
from keyss.fitting.plain import fit_scene
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.methods.learned.config import HideConfig
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.joint import JointRun, decoder_shape
from keyss.methods.learned.payload import ANCHORS, HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.revealing import decode, is_drawn
from keyss.methods.learned.scramble import (
    CHANNELS,
    KEY_BYTES,
    KNOTS,
    Scramble,
    with_lengths_of_the_cover,
)
from keyss.methods.learned.targets import PlacedScene


@dataclass(frozen=True)
class Hidden:
    """What hiding gives: what is published, what the keys open, and what stays private."""

    stego: Gaussians  # to be published; carries the sealed secrets in its low bits unless there is a sidecar
    sidecar: bytes | None
    secrets: tuple[HiddenSecret, ...]  # as they come out again with their keys
    plains: tuple[Gaussians, ...]  # plain models of the cover and the secrets, each in its own frame
    seconds: float  # of all training, that before a resume included


def hide_scenes(
    scenes: Sequence[Scene],
    keys: Sequence[str],
    config: HideConfig,
    *,
    plains: Sequence[Gaussians | None] | None = None,
    sidecar: bool = False,
    encoder: Callable[[str], Tensor] | None = None,
    device: torch.device | str = "cpu",
    checkpoints: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Hidden:
    """Hide `scenes[1:]` in `scenes[0]`, each to be opened by its key.

    `plains`: existing plain models, None for those to be fitted. `sidecar`: the sealed secrets go into a
    file of their own and not into the low bits of the stego model. `encoder`: from a key to the embedding
    [64] that conditions its decoder, by default what Argon2id gives. With `checkpoints` (a folder) the state
    of every stage is kept there, and `resume` goes on from it. Raises UsageError for keys that are equal or
    not one per secret and for a model too small for what it has to carry, Interrupted on Ctrl-C, InputError
    for checkpoints of another run.
    """
    if len(keys) != len(scenes) - 1 or not keys:
        raise UsageError(f"expected one key for each of {len(scenes) - 1} secret(s), got {len(keys)}")
    device = torch.device(device)
    derivation = KeyDerivation(salt=training_salt(scenes[0], config.fit.seed))
    derived = [DerivedKey(key, derivation) for key in keys]
    if any(a.equals(b) for a, b in combinations(derived, 2)):
        raise UsageError("two secrets have the same key: each needs its own")
    embeddings = [key.embedding() for key in derived] if encoder is None else [encoder(key) for key in keys]
    if not sidecar:
        check_room(_largest_payload(config), config.fit.max_gaussians, len(keys), config.fit.sh_degree)

    models, seconds = [], 0.0
    for index, (scene, given) in enumerate(zip(scenes, plains or [None] * len(scenes), strict=True)):
        if given is not None:
            models.append(given.with_sh_degree(config.fit.sh_degree))
            continue
        role = "cover" if index == 0 else "secret" if len(scenes) == 2 else f"secret {index}"
        result = fit_scene(
            scene,
            config.fit,
            device=device,
            title=f"plain model of the {role} ({scene.name})",
            checkpoint=checkpoints / f"plain-{index}.safetensors" if checkpoints else None,
            resume=resume,
            reporter=reporter,
        )
        models.append(result.gaussians)
        seconds += result.seconds

    cover_cameras = [view.camera for view in scenes[0].train]
    frames = [Similarity.identity()]
    frames += [align([view.camera for view in scene.train], cover_cameras) for scene in scenes[1:]]
    placed = [PlacedScene.of(*parts) for parts in zip(scenes, models, frames, strict=True)]
    run = JointRun(placed, embeddings, config, device)
    seconds += train(
        run,
        "hide",
        fingerprint={
            "scenes": [scene.digest() for scene in scenes],
            "models": [hashlib.sha256(model.means.numpy().tobytes()).hexdigest() for model in models],
            "keys": [
                hashlib.sha256(key.verifier() + embedding.numpy().tobytes()).hexdigest()
                for key, embedding in zip(derived, embeddings, strict=True)
            ],
            "config": json.loads(json.dumps(asdict(config))),  # tuples as they are read back
            "device": device.type,
        },
        seed=config.fit.seed,
        checkpoint=checkpoints / "joint.safetensors" if checkpoints else None,
        resume=resume,
        checkpoint_seconds=config.fit.checkpoint_seconds,
        evaluate_every=config.fit.evaluate_every,
        reporter=reporter,
    )
    stego = run.gaussians().to("cpu")
    decoders = [decoder.to("cpu").requires_grad_(False) for decoder in run.decoders]
    if run.warm:
        stego = stego[run.drawn().cpu()]
    scrambles: list[Scramble | None] = [None] * len(keys)
    if run.warm and not sidecar:  # a sidecar is for files that will be rounded, which no scramble survives
        for index, (key, decoder) in enumerate(zip(derived, decoders, strict=True)):
            if config.decoder == "curve":  # a network would see the difference
                stego = with_lengths_of_the_cover(stego, decoder.band)
            scramble = Scramble.of(stego, key.expand("scramble", KEY_BYTES), decoder.band)
            stego, scrambles[index] = scramble.close(stego), scramble
    anchors = choose_anchors(stego, torch.Generator().manual_seed(config.fit.seed))
    transparent = stego[~is_drawn(stego)]
    faint = None
    if sidecar and len(transparent):
        columns = [transparent.means, transparent.opacity_logits[:, None], transparent.sh[:, 0]]
        faint = torch.cat(columns, dim=1)
    hidden = [
        HiddenSecret(decoder, frame, anchors, scramble, faint)
        for decoder, frame, scramble in zip(decoders, frames[1:], scrambles, strict=True)
    ]
    counts = [int(is_drawn(decode(stego, secret, secret.embedding)).sum()) for secret in hidden]
    packed = [pack_secret(replace(secret, count=count)) for secret, count in zip(hidden, counts, strict=True)]
    sealed = None
    if sidecar:
        sealed = seal_sidecar(list(zip(keys, packed, strict=True)), entropy=_discarded(run, derived))
    else:
        stego = embed(stego, list(zip(keys, packed, strict=True)))
    return Hidden(stego, sealed, tuple(map(unpack_secret, packed)), tuple(models), seconds)


def _largest_payload(config: HideConfig) -> int:
    """Bytes of a secret whose decoder cannot be compressed."""
    decoder = Decoder(decoder_shape(config))
    scramble = None
    if config.start == "warm":
        tables = torch.rand(2, CHANNELS, KNOTS)
        scramble = Scramble(bytes(KEY_BYTES), (0.0, 1.0), tables[0], tables[1])
    secret = HiddenSecret(decoder, Similarity.identity(), torch.rand(ANCHORS, 3), scramble)
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
