"""Secrets trained to the size that the cover's low bits have room for; the cover stays as it is.

Where the published file keeps every bit, no Gaussian needs to serve two scenes. The cover is its plain model,
so that nothing tells the file from a plain one but what low bits tell. Of a secret's plain model the
Gaussians that contribute most are trained on, for as long as a joint training would, and carried as records.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.fitting.plain import refit_model
from keyss.keys import DerivedKey
from keyss.methods.base import Context, KeyedSource, Source, Stego
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.room import of_degree, prepared_cover, record_degree, secret_sizes
from keyss.methods.learned.start import most_contributing
from keyss.methods.records.embedding import embed_models
from keyss.methods.records.encoding import subsampled_counts


def hide_refitted(
    cover: Source,
    secrets: Sequence[KeyedSource],
    derived: Sequence[DerivedKey],
    options: LearnedOptions,
    context: Context,
    name: str,
) -> Stego:
    """The cover with the secrets in its low bits; `name`: of the method that opens them.

    Raises UsageError and InputError for a cover without room, Interrupted on Ctrl-C, and InputError for a
    checkpoint of another run.
    """
    fit = options.fit
    secret_of_writer = b"".join(key.expand("writer", 32) for key in derived)
    entropy = _entropy(b"cover", secret_of_writer)
    whole = of_degree(cover.model, fit.sh_degree, entropy)
    prepared = prepared_cover(whole, entropy)
    degree = record_degree(fit.sh_degree)
    if degree is None:
        raise ValueError(f"a model of SH degree {fit.sh_degree} has no room for records")
    wanted = [len(each.source.model) for each in secrets]
    sizes = secret_sizes(wanted, len(cover.model), prepared.carriers, options)
    models, seconds = [], 0.0
    for index, (secret, size) in enumerate(zip(secrets, sizes, strict=True), start=1):
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
            reporter=context.reporter,
        )
        models.append(found.gaussians)
        seconds += found.seconds
    embedded = embed_models(
        prepared,
        [each.key for each in secrets],
        models,
        subsampled_counts(prepared, models),
        name,
        entropy=_entropy(b"embed", secret_of_writer, *map(_bytes, models)),
    )
    return Stego(embedded.stego, None, embedded.opened, seconds, fit.iterations, embedded.details(whole))


def _bytes(model: Gaussians) -> bytes:
    return b"".join(values.numpy().tobytes() for values in vars(model).values())


def _entropy(*parts: bytes) -> bytes:
    """32 bytes that nobody knows without the keys and, for embedding, models that are not kept."""
    digest = hashlib.sha256(b"keyss/v1/discarded")
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.digest()
