"""The learned method: secrets trained for the cover that they are hidden in, and published as one model.

*Key-Secured 3D Secrets within 3D Gaussian Splatting* (KeySS), with the corrections in `docs/method.md`. By
default secrets are trained for the room in a cover that stays as it is (`keyss.methods.learned.refit`). From
points it is the paper's way: one frame for all scenes, joint training, encrypted decoders
(`keyss.methods.learned.publication`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any

from torch import Tensor

from keyss.channels.base import Content, Records
from keyss.channels.rooms import room_in
from keyss.core.alignment import align
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.loop import train
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.derivation import SALT_BYTES
from keyss.methods.base import (
    Capabilities,
    Context,
    KeyedSource,
    Opened,
    Outlook,
    SceneInput,
    Source,
    Stego,
)
from keyss.methods.learned.clip_keys import MODEL, ClipKeys
from keyss.methods.learned.decoder import untrained
from keyss.methods.learned.joint import JointRun
from keyss.methods.learned.options import (
    PRESETS,
    LearnedOptions,
    decoder_shape,
    decodings,
    sized,
    training_options,
)
from keyss.methods.learned.payload import unpack_secret
from keyss.methods.learned.publication import NAME, publish
from keyss.methods.learned.refit import hide_refitted
from keyss.methods.learned.room import (
    carriers_of,
    check_room,
    record_degree,
    secret_sizes,
)
from keyss.methods.points import divided
from keyss.methods.poses import PlacedScene
from keyss.methods.records.embedding import unpack_records
from keyss.methods.records.prospect import outlook_whole
from keyss.rendering.difference import cost

_clip_keys = lru_cache(maxsize=1)(ClipKeys)  # a large model that preparing and hiding share


class LearnedMethod:
    """See `keyss.methods.base.Method`."""

    name = NAME
    summary = "train the secrets for the cover, then carry them"
    trains = True
    most_secrets = 9
    capabilities = Capabilities()
    options = LearnedOptions
    presets: Mapping[str, LearnedOptions] = PRESETS

    def prepare(self, inputs: Sequence[SceneInput], options: LearnedOptions) -> LearnedOptions:
        """Sized for models where they are all there is; refuses models too small for their low bits."""
        options = sized(options, inputs)
        encoder_of(options)  # says what is missing
        if options.publish != "ply":
            if (cover := inputs[0].model) is not None:
                room_in(
                    cover, options.publish, options.channel, repair=options.repair
                )  # says what is missing
        else:
            check_room(options, [each.model for each in inputs])
        return options

    def outlook(self, inputs: Sequence[SceneInput], options: LearnedOptions) -> Outlook:
        """All that is within the cap; notes say what is lost of harmonics of a higher degree."""
        options = training_options(options)
        fit, cover = options.fit, inputs[0].model
        sizes = [fit.max_gaussians if each.model is None else len(each.model) for each in inputs]
        notes = []
        for role, each, degree in zip(_roles(inputs), inputs, _degrees(options, len(inputs)), strict=True):
            if each.model is not None and each.model.sh_degree > degree:
                psnr = cost(each.model, each.model.with_sh_degree(degree))
                notes.append(
                    f"{role} of SH degree {each.model.sh_degree} gets degree {degree}: {psnr:.1f} dB PSNR "
                    "against itself"
                )
        if options.publish != "ply":
            found = outlook_whole(inputs, options)
            share = found.capacity / max(1, found.asked)
            drawn = [0, *(int(share * each) for each in sizes[1:])]
            return replace(found, steps=fit.iterations, drawn=tuple(drawn), notes=(*notes, *found.notes))
        if options.start == "warm":
            gaussians = fit.max_gaussians if cover is None else len(cover)
            carriers = carriers_of(cover, gaussians, fit.sh_degree)
            drawn = [0, *secret_sizes(sizes[1:], gaussians, carriers, options)]
        else:
            gaussians = min(fit.max_gaussians, sum(sizes))
            drawn = divided(sizes, [1.0] * len(sizes), fit.max_gaussians)
        return Outlook(
            gaussians=gaussians,
            sh_degree=fit.sh_degree,
            asked=sum(sizes[1:]),
            capacity=sum(drawn[1:]),
            steps=fit.iterations,
            drawn=tuple(drawn),
            notes=tuple(notes),
            decode=None if options.start == "warm" else untrained(decoder_shape(options)),
            decodings=decodings(options, len(sizes) - 1),
        )

    def hide(
        self, cover: Source, secrets: Sequence[KeyedSource], options: LearnedOptions, context: Context
    ) -> Stego:
        """Train secrets for what the cover can carry, or cover and secrets together, and encrypt them.

        Raises UsageError for a cover too small for what it has to carry, Interrupted on Ctrl-C, and
        InputError for a checkpoint of another run.
        """
        options = training_options(options)
        sources, keys = [cover, *(each.source for each in secrets)], [each.key for each in secrets]
        scenes = [source.scene for source in sources]
        derivation = KeyDerivation(salt=training_salt(cover.scene, options.fit.known_seed))
        derived = [DerivedKey(key, derivation) for key in keys]
        details: dict[str, Any] = {}
        fewer = [
            round(cost(source.model, source.model.with_sh_degree(degree)), 1)
            for source, degree in zip(sources, _degrees(options, len(sources)), strict=True)
            if source.model.sh_degree > degree
        ]
        if fewer:
            details["psnr_of_fewer_harmonics"] = fewer
        if options.start == "warm":
            found = hide_refitted(cover, secrets, derived, options, context, NAME)
            return replace(found, details=details | dict(found.details))
        encoder = encoder_of(options)
        embeddings = (
            [key.embedding() for key in derived] if encoder is None else [encoder(key) for key in keys]
        )

        cover_cameras = [view.camera for view in scenes[0].train]
        frames = [Similarity.identity()]
        frames += [align([view.camera for view in scene.train], cover_cameras) for scene in scenes[1:]]
        models = [source.model for source in sources]
        placed = [PlacedScene.of(*parts) for parts in zip(scenes, models, frames, strict=True)]
        run = JointRun(placed, embeddings, options, context.device)
        seconds = train(
            run,
            "hide",
            fingerprint={
                "scenes": [scene.digest() for scene in scenes],
                "models": [model.digest() for model in models],
                "keys": [
                    hashlib.sha256(key.verifier() + embedding.numpy().tobytes()).hexdigest()
                    for key, embedding in zip(derived, embeddings, strict=True)
                ],
                "options": json.loads(json.dumps(asdict(options))),  # tuples as they are read back
            },
            seed=options.fit.known_seed,
            checkpoint=context.checkpoints / "joint.safetensors" if context.checkpoints else None,
            resume=context.resume,
            checkpoint_seconds=options.fit.checkpoint_seconds,
            evaluate_every=options.fit.evaluate_every,
            reporter=context.reporter,
        )
        published = publish(run, keys, frames[1:], options, _discarded(run, derived))
        return Stego(
            published.stego,
            published.opened,
            seconds,
            options.fit.iterations,
            details | published.details,
        )

    def unpack(self, content: Content) -> Opened:
        """The Gaussians themselves, or a decoder and where the secret lies. Raises InputError for damage."""
        if isinstance(content, Records):
            return unpack_records(content)
        return replace(unpack_secret(content.data), chunks=content.chunks)


def _roles(inputs: Sequence[SceneInput]) -> list[str]:
    return ["the cover", *["a secret"] * (len(inputs) - 1)]


def _degrees(options: LearnedOptions, scenes: int) -> list[int]:
    """SH degrees with which the cover and the secrets come out."""
    degree = options.fit.sh_degree
    if options.publish != "ply":
        return [degree, *[3] * (scenes - 1)]  # as they are
    of_secrets = record_degree(degree) if options.start == "warm" else degree
    return [degree, *[degree if of_secrets is None else of_secrets] * (scenes - 1)]


def encoder_of(options: LearnedOptions) -> Callable[[str], Tensor] | None:
    """From a key to the embedding [64] that conditions its decoder; None: Argon2id's. Raises BackendError."""
    if options.key_encoder == "argon2":
        return None
    return _clip_keys(options.clip_model or MODEL)


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
