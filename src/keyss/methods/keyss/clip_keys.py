"""The paper's key encoder: CLIP's text encoder, for comparison (KeySS, section 3.2).

It only conditions the decoder. The key that encrypts the payload is still derived from the typed text by
Argon2id, because CLIP is no key derivation: it is fast, it ignores case, and similar texts have similar
embeddings. Revealing needs no CLIP: the encrypted payload contains the embedding.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from keyss.core.errors import BackendError, UsageError
from keyss.core.extras import import_extra
from keyss.keys.derivation import EMBEDDING_SIZE, unit_vector
from keyss.keys.key_file import normalized_key

MODEL = "openai/clip-vit-large-patch14"  # ViT-L/14, the paper's


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
