"""A design of KeySS of your own: the decoder changes opacities only, and a wrong key costs ten times as much.

python examples/own_design.py SCENE_A SCENE_B out/own
"""

import sys
from dataclasses import replace

import keyss  # before torch
from keyss import KeyssOptions, Secret, generate_key
from keyss.methods import DESIGNS

published = DESIGNS["published"]
decoder = replace(published.decoder, mask=("op",))  # theta of equation 8
DESIGN = replace(published, name="opacities", decoder=decoder, beta_incorrect=0.1)  # equation 11

if __name__ == "__main__":
    cover, secret, out = sys.argv[1:]
    key = generate_key()
    options = KeyssOptions(design=DESIGN).with_fit(iterations=200, max_gaussians=2000)
    keyss.hide(
        cover, [Secret(secret, key)], method=options, views=keyss.ViewOptions(100), out=out, min_psnr=0
    )
    print(keyss.reveal(f"{out}/publish/model.ply", key).gaussians)
