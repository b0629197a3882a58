"""For each measure: what its numbers mean, and what they do not."""

from __future__ import annotations

from typing import NamedTuple


class Meaning(NamedTuple):
    means: str
    does_not: str


VERDICT = Meaning(
    "Fine: within the limit. Visible: somebody without the key may see that something is hidden, or see "
    "something of it. Missed: nothing shows, but the cover or the secret does not fare as well as it "
    "should.",
    "The limits are conventions, and that no measure here sees anything does not mean that none could.",
)
PICTURES = Meaning(
    "Test views: the photo, what is published or revealed, and plain 3DGS, the bound. Drag the border, or "
    "move it with the arrow keys.",
    "A few views show no more than a few views: means over all of them are below.",
)
IMAGES = Meaning(
    "How near renders come to photos that nothing was trained on, beside plain 3DGS of the same scene "
    "with as many Gaussians, steps and pixels: the bound. PSNR and SSIM are better when higher, LPIPS and "
    "FLIP when lower.",
    "Good pictures do not say that nothing can be found in the file; the sections on leaks and statistics "
    "look for that.",
)
WRONG_KEYS = Meaning(
    "A wrong key should show the cover: as near to the cover's photos as the published model is, and no "
    "nearer to the secret's than the floor, which is the published model itself held against them.",
    "A few random keys are no attack; that keys cannot be guessed rests on how they are derived.",
)
LEAKS = Meaning(
    "Somebody who knows this program but not the key changes the published file until something shows, "
    "and holds that against the secret's photos. Below each number stands how much better that is than "
    "the same done to a plain model of the cover: about 0 means that nothing of the secret was seen. "
    "PSNR and SSIM also count fog: a bright cloud is nearer to most photos than darkness. What tells the "
    "secret's shapes are the correlation of gradients, and PSNR and SSIM after the best fit of colours. In "
    "the pictures: the attack on the published file, the same on a plain model, the photo.",
    "These are the attacks that were thought of; they do not prove that there are no others.",
)
DISTANCES = Meaning(
    "How far the published Gaussians lie from those of plain models of the cover, attribute by attribute, "
    "as a multiple of the null: how far plain models from different seeds lie from each other.",
    "A ratio near 1 says that this attribute by itself gives nothing away; combinations of several may.",
)
TWO_SAMPLE = Meaning(
    "Boosted trees learn to tell Gaussians of the published model from those of a plain one. An AUC of "
    "0.5 is guessing; the null is the same between two plain models.",
    "It needs a plain model of the same scene, which an observer rarely has; and where trees fail another "
    "classifier may not.",
)
HISTOGRAMS = Meaning(
    "Shares of the Gaussians by value: the published model filled, plain models as lines. Where they "
    "part, somebody who knows what is usual may look.",
    "They show one attribute at a time, and no small share of unusual Gaussians.",
)
SINKHORN = Meaning(
    "The distance between a stego model and its cover that papers report, for comparison with theirs.",
    "It says little: it calls models identical whose scales are doubled or whose colours are swapped, is "
    "not 0 between a model and itself, and changes with lengths of quaternions that no render shows. It "
    "gets no verdict.",
)
RENDERS = Meaning(
    "Detectors of image steganography, on renders of the published model and of plain ones. An AUC of 0.5 "
    "is guessing.",
    "StegExpose looks for replaced low bits in 8-bit pixels, and a renderer computes its pixels anew: 0.5 "
    "is expected of whatever is hidden in a 3D model, and says little of what the model itself gives "
    "away.",
)
ROBUSTNESS = Meaning(
    "What changes of the published file cost the cover, which everybody sees, and the secret, opened with "
    "its key afterwards. On the line both lose the same, above it the secret loses more; a hollow mark "
    "did not open.",
    "These changes were not made against this file: who can change it on purpose can always destroy what "
    "is in it.",
)
SPEED = Meaning(
    "What the secret costs in time and bytes, and whether programs that know nothing of it open the file.",
    "Times hold for the machine that ran the audit; only their ratios travel.",
)
