"""The paper's key encoder, CLIP's text encoder (section 3.2, "The Key-Controllable Scheme").

It only conditions the decoder. Argon2id derives the encryption key from the typed text, because CLIP is no
key derivation function: it is fast, it ignores case, and similar texts have similar vectors. Revealing needs
no CLIP: the encrypted payload contains the vector.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from keyss.core.errors import BackendError, UsageError, import_extra
from keyss.keys.key_file import ALPHABET, normalized_key

MODEL = "openai/clip-vit-large-patch14"  # ViT-L/14 (section 4.1)


class ClipKeys:
    """`encoder(key)` returns the vector of a key: k = AvgPool(E(k)).

    `model`: a folder that `transformers` saved, or the name of a model in its cache; nothing is ever
    downloaded. Raises BackendError if `transformers` or the model is missing.
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
        """[768 for ViT-L/14] float32: the mean of the last hidden states over all tokens of the key.

        Raises UsageError for a key of more tokens than CLIP reads.
        """
        tokens = self._tokenizer(normalized_key(key), return_tensors="pt")
        most = self._text.config.max_position_embeddings
        if tokens["input_ids"].shape[1] > most:
            raise UsageError(f"the key is too long for CLIP: expected at most {most - 2} tokens")
        return self._text(**tokens).last_hidden_state[0].mean(0)  # type: ignore[no-any-return]

    def random(self, generator: torch.Generator) -> Tensor:
        """The vector of a random key of 16 alphanumeric characters (section 4.1)."""
        chosen = torch.randint(len(ALPHABET), (16,), generator=generator)
        return self("".join(ALPHABET[int(index)] for index in chosen))


clip_keys = lru_cache(maxsize=1)(ClipKeys)  # loads the large model once for preparing and hiding
