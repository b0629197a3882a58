"""The paper's text (KeySS, sections 3.2 to 3.4 and appendix)."""

from keyss.methods.keyss.designs.network import NetworkDesign

DESIGN = NetworkDesign(
    mask=("op", "ro", "sc", "xyz"),
    conditioning="bias",
    hidden=(64, 128),
    branch=64,
    frequencies=0,
    inputs="normalised",
    decoder_rate=5e-5,
    common_poses=1.0,
    incorrect_weight=0.01,
    incorrect_every=1,
    ssim_weight=0.5,
    growth="largest",
)
