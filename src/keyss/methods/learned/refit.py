"""Secrets trained to the size that the cover has room for; the cover stays as it is.

Where the published file keeps every bit, no Gaussian needs to serve two scenes. The cover is its plain model,
so that nothing tells the file from a plain one but what low bits tell. Of a secret's plain model the
Gaussians that contribute most are trained on, for as long as the plain model was, and carried as records.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from keyss.channels.low_bits import LowBitsCover
from keyss.channels.rooms import Room, room_in
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.loop import of_secret
from keyss.fitting.plain import refit_model
from keyss.keys import DerivedKey
from keyss.methods.base import Context, KeyedSource, Source, Stego
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.room import of_degree, prepared_cover, record_degree, secret_sizes
from keyss.methods.records.embedding import (
    Embedded,
    EmbeddedWhole,
    embed_models,
    embed_whole,
    shares_of,
)
from keyss.methods.records.encoding import subsampled_counts
from keyss.methods.records.precision import pruned
from keyss.rendering.contributions import contributions
from keyss.rendering.difference import Viewpoints

SELECTION_VIEWS = 64
_FITTING = 0.97  # of the Gaussians that fit before they are trained on: packed, they get longer or shorter


def hide_refitted(
    cover: Source,
    secrets: Sequence[KeyedSource],
    derived: Sequence[DerivedKey],
    options: LearnedOptions,
    context: Context,
    name: str,
) -> Stego:
    """The cover with the secrets in it; `name`: of the method that opens them in low bits.

    Raises UsageError and InputError for a cover without room, Interrupted on Ctrl-C, and InputError for a
    checkpoint of another run.
    """
    fit = options.fit
    secret_of_writer = b"".join(key.expand("writer", 32) for key in derived)
    place: _InRecords | _Whole
    if options.publish == "ply":
        place = _InRecords.of(cover.model, options, _entropy(b"cover", secret_of_writer), name)
    else:
        model = cover.model.with_sh_degree(min(cover.model.sh_degree, fit.sh_degree))
        views = [Viewpoints.of(each.source.scene) for each in secrets]
        place = _Whole(room_in(model, options.publish, options.channel, repair=options.repair), views)
    sizes = place.sizes([each.source.model for each in secrets])
    models, seconds = [], 0.0
    for index, (secret, (size, degree)) in enumerate(zip(secrets, sizes, strict=True), start=1):
        scene, plain = secret.source.scene, secret.source.model.with_sh_degree(degree)
        # As an independent run each: what becomes of one must not depend on the others.
        found = refit_model(
            scene,
            most_contributing(plain, scene, size),
            replace(fit, seed=fit.seed_of(f"secret {index}")),
            rate=options.warm_rate,
            device=context.device,
            title="refit of the secret" if len(secrets) == 1 else f"refit of secret {index}",
            checkpoint=context.checkpoints / f"secret-{index}.safetensors" if context.checkpoints else None,
            resume=context.resume,
            reporter=of_secret(context.reporter),
        )
        models.append(found.gaussians)
        seconds += found.seconds
    entropy = _entropy(b"embed", secret_of_writer, *map(_bytes, models))
    embedded, details = place.embed([each.key for each in secrets], models, entropy)
    return Stego(embedded.stego, embedded.opened, seconds, fit.iterations, details)


@dataclass(frozen=True)
class _InRecords:
    """Gaussian by Gaussian in the cover's low bits."""

    cover: Gaussians
    prepared: LowBitsCover
    options: LearnedOptions
    degree: int  # of the secrets
    name: str

    @staticmethod
    def of(cover: Gaussians, options: LearnedOptions, entropy: bytes, name: str) -> _InRecords:
        cover = of_degree(cover, options.fit.sh_degree, entropy)
        degree = record_degree(options.fit.sh_degree)
        if degree is None:
            raise ValueError(f"a model of SH degree {options.fit.sh_degree} has no room for records")
        return _InRecords(cover, prepared_cover(cover, entropy), options, degree, name)

    def sizes(self, plain: Sequence[Gaussians]) -> list[tuple[int, int]]:
        """Gaussians and SH degree that each secret is trained with."""
        found = secret_sizes(list(map(len, plain)), len(self.cover), self.prepared.carriers, self.options)
        return [(size, self.degree) for size in found]

    def embed(
        self, keys: Sequence[str], models: Sequence[Gaussians], entropy: bytes
    ) -> tuple[Embedded, dict[str, Any]]:
        counts = subsampled_counts(self.prepared, models)
        found = embed_models(self.prepared, keys, models, counts, self.name, entropy=entropy)
        return found, found.details(self.cover)


@dataclass(frozen=True)
class _Whole:
    """Each as one string of bytes."""

    room: Room
    viewpoints: Sequence[Viewpoints]

    def sizes(self, plain: Sequence[Gaussians]) -> list[tuple[int, int]]:
        """Gaussians and SH degree that each secret is trained with: a few fewer than would fit untrained."""
        found = []
        for model, share, views in zip(plain, shares_of(self.room, plain), self.viewpoints, strict=True):
            kept = pruned(model, share, views)
            count = len(kept) if len(kept) == len(model) else max(1, int(_FITTING * len(kept)))
            found.append((count, kept.sh_degree))
        return found

    def embed(
        self, keys: Sequence[str], models: Sequence[Gaussians], entropy: bytes
    ) -> tuple[EmbeddedWhole, dict[str, Any]]:
        found = embed_whole(self.room, keys, models, self.viewpoints, prune=True, entropy=entropy)
        return found, found.details


def most_contributing(plain: Gaussians, scene: Scene, count: int) -> Gaussians:
    """The `count` Gaussians that add most to what the training views show, in their order."""
    if count >= len(plain):
        return plain
    cameras = [view.camera for view in subsample_views(scene.train, SELECTION_VIEWS)]
    return plain[contributions(plain, cameras).topk(count).indices.sort().values]


def _bytes(model: Gaussians) -> bytes:
    return b"".join(values.numpy().tobytes() for values in vars(model).values())


def _entropy(*parts: bytes) -> bytes:
    """32 bytes that nobody knows without the keys and, for embedding, models that are not kept."""
    digest = hashlib.sha256(b"keyss/v1/discarded")
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.digest()
