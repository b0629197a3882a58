"""What is to be seen of a secret without its key: attacks, beside the same attacks on plain models."""

from keyss.measure.leaks.attacks import Attack, decoder_attacks, file_attacks
from keyss.measure.leaks.looking import attack, look_for_secret
from keyss.measure.leaks.scores import SCORES, coarse, fit_colours, gradient_correlation, scores

__all__ = [
    "SCORES",
    "Attack",
    "attack",
    "coarse",
    "decoder_attacks",
    "file_attacks",
    "fit_colours",
    "gradient_correlation",
    "look_for_secret",
    "scores",
]
