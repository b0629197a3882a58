"""A limit, not a promise: what the learned method leaves for everybody to see, and carrying does not."""

from __future__ import annotations

import torch

import keyss
from hiding.test_joint import CONFIG, _psnr, _scenes
from keyss.core import Gaussians
from keyss.hiding.decoder import Decoder, DecoderShape
from keyss.hiding.pipeline import hide_scenes
from keyss.hiding.start import opacity_curve
from keyss.seal import random_embeddings
from tiny_scenes import random_gaussians


def _without_a_key(stego: Gaussians) -> Gaussians:
    """What the program's source alone tells of the first secret."""
    embedding = random_embeddings(1, torch.Generator().manual_seed(0))[0]
    decoder = Decoder(DecoderShape())
    decoder.prepare(stego, embedding)
    decoder.set_curve(*opacity_curve(0))
    shown: Gaussians = decoder(stego, embedding)
    return shown


def test_ghosts_of_a_learned_secret_show_it_without_a_key_and_carrying_has_none() -> None:
    scenes, models = _scenes()
    scenes, models = [scenes[0], scenes[2]], [models[0], models[2]]
    learned = hide_scenes(scenes, ["a key"], CONFIG, plains=models, sidecar=True)
    # In the cover's frame; a person would walk around until it looks right.
    back = learned.secrets[0].frame.inverse()
    ghosts = back.apply_gaussians(_without_a_key(learned.stego))
    assert _psnr(ghosts, scenes[1]) > _psnr(back.apply_gaussians(learned.stego), scenes[1]) + 10
    cover = random_gaussians(1500, seed=0)
    carried = keyss.hide(cover, [keyss.Secret(models[1], "a key")], method="carry").stego
    assert _psnr(_without_a_key(carried), scenes[1]) < _psnr(cover, scenes[1]) + 1
