"""KeySS, *Key-Secured 3D Secrets within 3D Gaussian Splatting*, with the corrections in `docs/keyss.md`.

All scenes are brought into one frame and trained jointly from their sparse points. Each secret has a decoder,
which is encrypted with its key in the published model.

The paper's key encoder, CLIP's text encoder (section 3.2), is there for comparison. It only conditions the
decoder. The key that encrypts the payload is still derived from the typed text by Argon2id, because CLIP is
no key derivation: it is fast, it ignores case, and similar texts have similar embeddings. Revealing needs no
CLIP: the encrypted payload contains the embedding.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from keyss.channels import APPENDED, LOW_BITS, check_payload_fits
from keyss.core.errors import BackendError, KeyssError, KeyssWarning, UsageError, import_extra
from keyss.keys import DerivedKey
from keyss.keys.derivation import EMBEDDING_SIZE, SALT_BYTES, expand, unit_vector
from keyss.keys.key_file import normalized_key
from keyss.methods.base import Capabilities, Context, Plan, Source, Stego
from keyss.methods.joint import train_jointly
from keyss.methods.keyss.designs.base import DesignTraining
from keyss.methods.keyss.options import KeyssOptions
from keyss.methods.keyss.secret import unpack

MODEL = "openai/clip-vit-large-patch14"  # ViT-L/14, the paper's
_APPENDED = "the secrets lie in appended Gaussians instead, which everybody can see in the file"


class ClipKeys:
    """`encoder(key)` returns the embedding of a key.

    `model`: a folder that holds CLIP as `transformers` saves it, or the name of a model in its cache; nothing
    is ever downloaded. Raises BackendError when `transformers` or the model is not there.
    """

    def __init__(self, model: str | Path = MODEL) -> None:
        transformers = import_extra("transformers", "clip", "encode keys with CLIP")
        try:
            self._tokenizer = transformers.CLIPTokenizer.from_pretrained(str(model), local_files_only=True)
            self._text = transformers.CLIPTextModel.from_pretrained(str(model), local_files_only=True).eval()
        except (OSError, ValueError, TypeError) as error:
            raise BackendError(
                f"no CLIP text encoder in {model}: set `clip_model` to a folder with one; nothing is "
                "downloaded (pip install 'keyss[clip]' installs the code only)"
            ) from error

    @torch.no_grad()
    def __call__(self, key: str) -> Tensor:
        """[64] float32 unit vector: the mean of CLIP's last hidden states over the key's tokens, start and
        end included, projected from its own size (768 in ViT-L/14) by a fixed random matrix.

        Random projection keeps angles to about 0.1 (Johnson and Lindenstrauss); the decoder takes 64 numbers.
        Raises UsageError for a key of more tokens than CLIP reads, which it would cut off.
        """
        tokens = self._tokenizer(normalized_key(key), return_tensors="pt")
        most = self._text.config.max_position_embeddings
        if tokens["input_ids"].shape[1] > most:
            raise UsageError(f"the key is too long for CLIP: expected at most {most - 2} tokens")
        mean = self._text(**tokens).last_hidden_state[0].double().mean(0)
        generator = torch.Generator().manual_seed(0)
        projection = torch.randn(EMBEDDING_SIZE, len(mean), generator=generator, dtype=torch.float64)
        return unit_vector(projection @ mean)


_clip_keys = lru_cache(maxsize=1)(ClipKeys)  # a large model that preparing and hiding share


class KeyssMethod:
    """See `keyss.methods.base.Method`."""

    name = KeyssOptions.method
    summary = "train one model and a decoder for each key jointly, as the paper does"
    max_secrets = 9
    capabilities = Capabilities()
    options = KeyssOptions

    def prepare(self, sources: Sequence[Source], options: KeyssOptions) -> KeyssOptions:
        """Sets the design's loss. Warns (KeyssWarning) of models too small for the payloads' low bits.

        Raises UsageError for more secrets than the design can hide.
        """
        if (weight := options.settings.ssim_weight) is not None:
            options = options.with_fit(ssim_weight=weight)
        encoder_of(options)  # raises where CLIP is missing
        fit, secrets = options.fit, len(sources) - 1
        size = options.settings.payload_bytes(fit.sh_degree, secrets)
        try:
            check_payload_fits(size, fit.max_gaussians, secrets, fit.sh_degree)
        except UsageError as error:
            warnings.warn(f"{error}; {_APPENDED}", KeyssWarning, stacklevel=2)
        return options

    def plan(self, sources: Sequence[Source], options: KeyssOptions) -> Plan:
        """All scenes share as many Gaussians as a plain model has."""
        secrets = len(sources) - 1
        weights = options.settings.weights(options.fit.sh_degree, secrets)
        return options.joint_plan(secrets, gaussian_weights=weights)

    def hide(
        self, cover: Source, secrets: Sequence[Source], options: KeyssOptions, context: Context
    ) -> Stego:
        """Train the cover and the secrets together, and encrypt what reveals each.

        Raises Interrupted on Ctrl-C, and InputError for a checkpoint of another run.
        """
        keys = [each.key for each in secrets]
        encoder, entropy = encoder_of(options), context.entropy or os.urandom(32)
        if encoder is None:
            salt = expand(entropy, "keyss/embedding-salt", SALT_BYTES)
            embeddings = [DerivedKey.of(key, salt).embedding() for key in keys]
        else:
            embeddings = [encoder(key) for key in keys]
        training: type[DesignTraining] = options.settings.training
        run = train_jointly(
            lambda placed: training(placed, embeddings, options, context.device), cover, secrets, context
        )
        return _embedded(run, keys, entropy)


def _embedded(run: DesignTraining, keys: Sequence[str], entropy: bytes) -> Stego:
    """The published model with the payload of each secret under its key.

    Warns (KeyssWarning) where the low bits have no room, in which case payloads are in appended Gaussians.
    """
    stego, secrets = run.publish(entropy)
    payloads = [secret.payload() for secret in secrets]
    keyed = list(zip(keys, payloads, strict=True))
    details: dict[str, Any] = {}
    try:
        found = LOW_BITS.prepare(stego).embed(keyed, entropy=entropy)
    except KeyssError as error:
        found = APPENDED.prepare(stego).embed(keyed, entropy=entropy)
        warnings.warn(f"{error}; {_APPENDED}", KeyssWarning, stacklevel=2)
        details["appended_because"] = str(error)
    return Stego(found, tuple(map(unpack, payloads)), run.iterations, details)


def encoder_of(options: KeyssOptions) -> Callable[[str], Tensor] | None:
    """From a key to the embedding [64] that conditions its decoder; None: Argon2id's. Raises BackendError."""
    if options.key_encoder == "argon2":
        return None
    return _clip_keys(options.clip_model or MODEL)


METHOD = KeyssMethod()
