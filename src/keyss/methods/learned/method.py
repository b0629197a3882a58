"""The learned method: one model trained to show the cover, and through a keyed decoder the secrets.

*Key-Secured 3D Secrets within 3D Gaussian Splatting* (KeySS), with the corrections in `docs/method.md`: one
frame for all scenes, joint training, encryption.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from keyss.channels.base import Content, Payload
from keyss.channels.low_bits import LOW_BITS
from keyss.channels.low_bits.bits import usable_carriers
from keyss.channels.low_bits.spread import check_payload_fits
from keyss.channels.sidecar import encrypt_sidecar
from keyss.core.alignment import align
from keyss.core.errors import InputError, KeyssError, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.loop import train
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES, expand, stream
from keyss.methods.base import Context, KeyedSource, Opened, Outlook, SceneInput, Source, Stego, advising
from keyss.methods.dither import cost, dither, raised, sampled
from keyss.methods.learned.attacks import known_remaps
from keyss.methods.learned.clip_keys import MODEL, ClipKeys
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import PRESETS, LearnedOptions, decoder_shape, sized, training_options
from keyss.methods.learned.payload import ANCHORS, HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.rank_shift import CHANNELS, KEY_BYTES, KNOTS, RankShift, match_quaternion_lengths
from keyss.methods.learned.start import divided
from keyss.methods.learned.targets import PlacedScene

NAME = "learned"
# Of the Gaussians before training, which brings those that it reaches, about half and more, to 0.72.
LEAST_USABLE_AT_START = 0.28
_SIDECAR = "`sidecar=True` writes a file beside it instead"
_clip_keys = lru_cache(maxsize=1)(ClipKeys)  # a large model that preparing and hiding share


class LearnedMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "train one model that shows both"
    trains = True
    most_secrets = 9
    options = LearnedOptions
    presets: Mapping[str, LearnedOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: LearnedOptions) -> LearnedOptions:
        """Sized for models where they are all there is; refuses models too small for their low bits."""
        options = sized(options, inputs)
        encoder_of(options)  # says what is missing
        if not options.sidecar:
            check_room(options, [each.model for each in inputs])
        return options

    def outlook(self, inputs: Sequence[SceneInput], options: LearnedOptions) -> Outlook:
        """All that is within the cap; notes say what is lost of harmonics of a higher degree."""
        training = training_options(options).fit
        sizes = [training.max_gaussians if each.model is None else len(each.model) for each in inputs]
        degree = training.sh_degree
        notes = []
        for role, each in zip(("the cover", *["a secret"] * len(inputs[1:])), inputs, strict=True):
            if each.model is not None and each.model.sh_degree > degree:
                psnr = cost(each.model, each.model.with_sh_degree(degree))
                notes.append(
                    f"{role} of SH degree {each.model.sh_degree} gets degree {degree}: {psnr:.1f} dB PSNR "
                    "against itself"
                )
        weights = [1.0] + [options.secret_share] * (len(sizes) - 1)
        return Outlook(
            gaussians=min(training.max_gaussians, sum(sizes)),
            sh_degree=degree,
            asked=sum(sizes[1:]),
            capacity=sum(divided(sizes, weights, training.max_gaussians)[1:]),
            steps=training.iterations,
            notes=tuple(notes),
        )

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: LearnedOptions, context: Context
    ) -> Stego:
        """Train the model that shows both, then encrypt the decoders into it or into a sidecar.

        Raises UsageError for a model too small for what it has to carry, Interrupted on Ctrl-C, and
        InputError for a checkpoint of another run.
        """
        options = training_options(options)
        sources, keys = [cover, *(each.source for each in secrets)], [each.key for each in secrets]
        scenes = [source.scene for source in sources]
        derivation = KeyDerivation(salt=training_salt(cover.scene, options.fit.seed))
        derived = [DerivedKey(key, derivation) for key in keys]
        # What training does not reach keeps its low bits: those of a quantised model would be no good.
        entropy = hashlib.sha256(b"keyss/v1/dither" + b"".join(key.expand("writer", 32) for key in derived))
        models = [
            with_low_bits(source.model, options.fit.sh_degree, expand(entropy.digest(), f"model/{index}", 32))
            for index, source in enumerate(sources)
        ]
        encoder = encoder_of(options)
        embeddings = (
            [key.embedding() for key in derived] if encoder is None else [encoder(key) for key in keys]
        )

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
        discarded = _discarded(run, derived)
        stego, packed = _as_published(run, derived, frames[1:], options, discarded)
        payloads = [(key, Payload(NAME, data)) for key, data in zip(keys, packed, strict=True)]
        sidecar = None
        details: dict[str, Any] = {}
        if any(source.model.sh_degree > options.fit.sh_degree for source in sources):
            details["psnr_of_fewer_harmonics"] = [
                round(cost(source.model, source.model.with_sh_degree(options.fit.sh_degree)), 1)
                for source in sources
                if source.model.sh_degree > options.fit.sh_degree
            ]
        if not options.sidecar:
            try:
                stego = LOW_BITS.prepare(stego).embed(payloads, entropy=discarded)
            except KeyssError as error:  # of fitted models that is not known before; the training is not lost
                details["sidecar_because"] = str(error)
        if options.sidecar or "sidecar_because" in details:
            sidecar = encrypt_sidecar(payloads, entropy=discarded)
        opened = tuple(map(unpack_secret, packed))
        return Stego(stego, sidecar, opened, seconds, options.fit.iterations, details)

    def unpack(self, content: Content) -> Opened:
        """A decoder, and where the secret lies. Raises InputError for damage."""
        if not isinstance(content, Payload):
            raise InputError("the hidden secret is damaged: expected one payload, got records")
        return replace(unpack_secret(content.data), chunks=content.chunks)

    def attacks(self, stego: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
        """The opacity remaps of a warm start are in the source; nothing else is known without a key."""
        return known_remaps(stego, secrets)


def _as_published(
    run: JointRun,
    keys: Sequence[DerivedKey],
    frames: Sequence[Similarity],  # of the secrets
    options: LearnedOptions,
    discarded: bytes,
) -> tuple[Gaussians, list[bytes]]:
    """The trained model without what training left in it, its secrets encrypted; and their payloads.

    Training has the cover's Gaussians first and the secrets' after them, in the order of their plain models:
    published are all of them in a random order.
    """
    stego = run.gaussians().to("cpu")
    decoders = [decoder.to("cpu").requires_grad_(False) for decoder in run.decoders]
    if run.warm:
        stego = stego[run.drawn().cpu()]
    numbers = np.frombuffer(stream(discarded, "order", 8 * len(stego)), "<u8")
    stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
    rank_shifts: list[RankShift | None] = [None] * len(keys)
    # A sidecar is for files that will be rounded, and no keyed rank shift survives rounding.
    if run.warm and not options.sidecar:
        for index, (key, decoder) in enumerate(zip(keys, decoders, strict=True)):
            if options.decoder == "remap":  # a network would see the difference
                stego = match_quaternion_lengths(stego, decoder.band.outer)
            shift = RankShift.of(stego, key.expand("rank-shift", KEY_BYTES), decoder.band.outer)
            stego, rank_shifts[index] = shift.encrypt(stego), shift
    anchors = choose_anchors(stego, torch.Generator().manual_seed(options.fit.seed))
    transparent = stego[stego.opacities < DRAWN_OPACITY]
    faint = None
    if options.sidecar and len(transparent):
        columns = [transparent.means, transparent.opacity_logits[:, None], transparent.sh[:, 0]]
        faint = torch.cat(columns, dim=1)
    packed = []
    for decoder, frame, rank_shift in zip(decoders, frames, rank_shifts, strict=True):
        secret = HiddenSecret(decoder, frame, anchors, rank_shift, faint)
        drawn = secret.decode(stego, secret.embedding).opacities >= DRAWN_OPACITY
        packed.append(pack_secret(replace(secret, count=int(drawn.sum()))))
    return stego, packed


def encoder_of(options: LearnedOptions) -> Callable[[str], Tensor] | None:
    """From a key to the embedding [64] that conditions its decoder; None: Argon2id's. Raises BackendError."""
    if options.key_encoder == "argon2":
        return None
    return _clip_keys(options.clip_model or MODEL)


def with_low_bits(model: Gaussians, sh_degree: int, entropy: bytes) -> Gaussians:
    """`model` as the joint training starts from it, with low bits that are random before the first step."""
    first, second = (expand(entropy, f"start/{index}", 32) for index in range(2))
    return dither(raised(model.with_sh_degree(min(sh_degree, model.sh_degree)), sh_degree, first), second)


def check_room(options: LearnedOptions, models: Sequence[Gaussians | None]) -> None:
    """Raise UsageError or InputError if the payloads will not fit into the model that is to be trained.

    `models`: of the cover and of the secrets, those that are known. A warm start from them adds no Gaussians
    and leaves the low bits of some as they are.
    """
    options = training_options(options)
    degree, cap = options.fit.sh_degree, options.fit.max_gaussians
    known = [model for model in models if model is not None]
    payload, secrets = _largest_payload(options), len(models) - 1
    if degree == 0:
        with advising(UsageError, f"`sh_degree=1` makes room{_growth(known)}, {_SIDECAR}"):
            check_payload_fits(payload, cap, secrets, degree)
    if options.start != "warm" or len(known) < len(models):
        with advising(UsageError, f"a larger `max_gaussians` makes room, {_SIDECAR}"):
            check_payload_fits(payload, cap, secrets, degree)
        return
    counts = [len(model) for model in known]
    started = [with_low_bits(sampled(model), degree, os.urandom(32)) for model in known]
    share = float(np.average([usable_carriers(model).mean() for model in started], weights=counts))
    if share < LEAST_USABLE_AT_START:
        raise InputError(
            f"only {share:.0%} of the Gaussians could have random low bits, the others hold equal values; "
            f"{_SIDECAR}"
        )
    with advising(UsageError, _SIDECAR):
        check_payload_fits(payload, min(cap, sum(counts)), secrets, degree, usable=share)


def _growth(models: Sequence[Gaussians]) -> str:
    """What it costs that a model of SH degree 0 gets degree 1."""
    if not models:
        return ""
    before, after = (len(models[0]) * 4 * (14 + 3 * count) / 1e6 for count in (1, 4))
    return f" (the cover's own Gaussians take {after:.1f} MB then instead of {before:.1f})"


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
