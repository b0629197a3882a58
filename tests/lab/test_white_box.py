"""A gradient search opens an unencrypted decoder; nothing is trained."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from keyss.core import Gaussians
from keyss.keys import random_embeddings
from keyss.lab import search_embeddings
from keyss.methods import Decoder, DecoderShape
from tiny_scenes import random_gaussians

KEY = random_embeddings(1, torch.Generator().manual_seed(3))[0]


def _exchanging() -> Decoder:
    """A decoder that makes x < 0 fainter and x > 0 more opaque, in proportion to the key's similarity to KEY.

    Each layer has two units, key . KEY plus and minus x; the last layer takes the difference.
    """
    decoder = Decoder(DecoderShape(mask=("op",), hidden=(2, 2), branch=2)).requires_grad_(False)
    first, second = decoder.common[0], decoder.common[2]
    third, last = decoder.branches["op"][0], decoder.branches["op"][2]
    sides = torch.tensor([1.0, -1.0])
    first.weight.zero_()
    first.weight[:, 8] = sides  # features: opacity, rotation 4, scale 3, position
    first.weight[:, -64:] = KEY
    first.bias.zero_()
    for layer in (second, third):
        layer.weight.copy_(torch.eye(2))
        layer.bias.zero_()
    last.weight.copy_(torch.tensor([[3.0, -3.0]]))
    last.bias.zero_()
    return decoder


def test_gradient_search_finds_the_key() -> None:
    """The attacker chooses by score, without knowing the secret."""
    decoder, model = _exchanging(), random_gaussians(400)

    def decode(stego: Gaussians, key: torch.Tensor) -> Gaussians:
        return decoder(stego, key)  # type: ignore[no-any-return]

    found = search_embeddings(decode, model, restarts=4, balance=0.0)
    assert float(F.cosine_similarity(found[0], KEY, dim=0)) > 0.9
    random = random_embeddings(100, torch.Generator().manual_seed(4))
    assert float(F.cosine_similarity(random, KEY, dim=1).max()) < 0.5
