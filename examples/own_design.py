"""A design of KeySS of your own: as published, but the decoder moves no Gaussian further than REACH.

python examples/own_design.py SCENE_A SCENE_B out/bounded
"""

import sys
from dataclasses import replace

import keyss  # before torch
from keyss import KeyssOptions, Secret, generate_key
from keyss.methods import DECODERS, DESIGNS, Decoder

REACH = 0.1  # world units


class BoundedDecoder(Decoder):
    """The paper's decoder with bounded residuals of positions (equation 8)."""

    def add_residuals(self, cover, residuals):
        xyz = REACH * residuals["xyz"].tanh()
        return super().add_residuals(cover, {**residuals, "xyz": xyz})


DECODERS["bounded"] = BoundedDecoder  # whoever reveals such a secret imports this file, too

published = DESIGNS["published"]
DESIGN = replace(published, name="bounded", decoder=replace(published.decoder, kind="bounded"))

if __name__ == "__main__":
    cover, secret, out = sys.argv[1:]
    key = generate_key()
    options = KeyssOptions(design=DESIGN).with_fit(iterations=200, max_gaussians=2000)
    keyss.hide(cover, [Secret(secret, key)], method=options, width=100, out=out, min_psnr=0)
    print(keyss.reveal(f"{out}/publish/model.ply", key).gaussians)
