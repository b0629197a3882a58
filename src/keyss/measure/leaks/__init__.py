"""What is to be seen of a secret without its key: attacks, beside the same attacks on plain models."""

from keyss.measure.leaks.attacks import Attack, decoder_attack, file_attacks, source_attack, with_the_key
from keyss.measure.leaks.looking import AttackResult, attack, look_for_secret
from keyss.measure.leaks.scores import LeakScores, coarse, fit_colours, gradient_correlation, scores

__all__ = [
    "Attack",
    "AttackResult",
    "LeakScores",
    "attack",
    "coarse",
    "decoder_attack",
    "file_attacks",
    "fit_colours",
    "gradient_correlation",
    "look_for_secret",
    "scores",
    "source_attack",
    "with_the_key",
]
