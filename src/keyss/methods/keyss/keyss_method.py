"""KeySS, *Key-Secured 3D Secrets within 3D Gaussian Splatting*.

Read `options` (the paper's symbols and values), `decoder` (equations 3, 6 and 8) and `training` (poses and
points, losses 4, 5 and 7, their sum 11, one step, publishing). `LatentDecoder`, `latent` and
`keyss.fitting.density.FixedRows` are the default design (ours); `secret` is the hidden payload.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from keyss.channels import APPENDED, LOW_BITS, check_payload_fits
from keyss.channels.harmonics import KEPT_DEGREE
from keyss.core.errors import KeyssError, KeyssWarning, UsageError
from keyss.core.similarity import Similarity
from keyss.keys import DerivedKey
from keyss.keys.clip import MODEL, ClipKeys, clip_keys
from keyss.keys.derivation import SALT_BYTES, expand
from keyss.methods.keyss.decoder import DECODERS
from keyss.methods.keyss.keyss_options import Design, KeyssOptions
from keyss.methods.keyss.keyss_secret import ANCHORS, KeyssSecret
from keyss.methods.keyss.latent import LatentTraining
from keyss.methods.keyss.training import KeyssTraining, PlacedScene
from keyss.methods.method import Capabilities, Context, Plan, Source, Stego

_APPENDED = "the secrets lie in appended Gaussians instead, which everybody can see in the file"


class KeyssMethod:
    """See `keyss.methods.method.Method`."""

    name = KeyssOptions.method
    max_secrets = 9
    capabilities = Capabilities()
    options = KeyssOptions

    def prepare(self, sources: Sequence[Source], options: KeyssOptions) -> KeyssOptions:
        """Set the design's loss. Warns (KeyssWarning) if models are too small for the payloads' low bits.

        Raises UsageError for more secrets than the design can hide, BackendError if CLIP is missing.
        """
        design, secrets = options.configuration, len(sources) - 1
        if design.ssim_weight is not None:
            options = options.with_fit(ssim_weight=design.ssim_weight)
        shape = replace(design.decoder, sh_degree=options.fit.sh_degree, secrets=secrets)
        if shape.kind not in DECODERS:
            raise UsageError(f"decoder of kind {shape.kind!r}: expected one of {', '.join(DECODERS)}")
        _encoder(options)
        probe = KeyssSecret(
            DECODERS[shape.kind](shape), torch.zeros(shape.key_size), Similarity(), torch.rand(ANCHORS, 3)
        )
        degree = KEPT_DEGREE if shape.kind == "latent" else shape.sh_degree
        try:
            check_payload_fits(len(probe.payload().data), options.fit.max_gaussians, secrets, degree)
        except UsageError as error:
            warnings.warn(f"{error}; {_APPENDED}", KeyssWarning, stacklevel=2)
        return options

    def plan(self, sources: Sequence[Source], options: KeyssOptions) -> Plan:
        """All scenes share the Gaussians of one model."""
        return options.joint_plan(len(sources) - 1)

    def hide(
        self, cover: Source, secrets: Sequence[Source], options: KeyssOptions, context: Context
    ) -> Stego:
        """Train the cover and the secrets jointly, and hide a payload for each secret.

        Raises Interrupted on Ctrl-C, and InputError for a checkpoint of another run.
        """
        keys, design = [each.key for each in secrets], options.configuration
        entropy = context.entropy or os.urandom(32)
        if encoder := _encoder(options):
            vectors = [encoder(key) for key in keys]
        else:
            salt = expand(entropy, "keyss/embedding-salt", SALT_BYTES)
            vectors = [DerivedKey.of(key, salt).embedding() for key in keys]
        sources, random_key = [cover, *secrets], encoder.random if encoder else None
        placed = PlacedScene.all_of(sources)
        run = training_of(design)(placed, vectors, options, context.device, random_key)
        run.train(sources, context)
        stego, hidden = run.publish(entropy)
        payloads = [secret.payload() for secret in hidden]
        keyed = list(zip(keys, payloads, strict=True))
        details: dict[str, Any] = {}
        # Low bits of harmonics that hold latents are not free.
        degree = KEPT_DEGREE if design.decoder.kind == "latent" else None
        try:
            found = LOW_BITS.prepare(stego, sh_degree=degree).embed(keyed, entropy=entropy)
        except KeyssError as error:
            found = APPENDED.prepare(stego).embed(keyed, entropy=entropy)
            warnings.warn(f"{error}; {_APPENDED}", KeyssWarning, stacklevel=2)
            details["appended_because"] = str(error)
        return Stego(found, tuple(map(KeyssSecret.of, payloads)), run.iterations, details)


def training_of(design: Design) -> type[KeyssTraining]:
    """The class of a design's training."""
    return LatentTraining if design.decoder.kind == "latent" else KeyssTraining


def _encoder(options: KeyssOptions) -> ClipKeys | None:
    """CLIP, if it is the key encoder. Raises BackendError if it is missing."""
    return clip_keys(options.clip_model or MODEL) if options.key_encoder == "clip" else None


METHOD = KeyssMethod()
