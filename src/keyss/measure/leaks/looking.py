"""Runs attacks on a stego model and on plain models, and scores the images against the secret."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.leaks.attacks import Attack
from keyss.measure.leaks.scores import LeakScores, leak_scores
from keyss.rendering import render

_GAP = 4  # pixels between the parts of a picture


@dataclass(frozen=True)
class AttackResult:
    """How much more of a secret an attack shows in the stego model than in control models.

    An attack has variants: thresholds, shares, clusters. The maximum over them counts, since an attacker
    recognises the secret.
    """

    attack: str
    sentence: str
    with_key: bool  # not an attack, but the revealed secret
    scores: LeakScores  # each the maximum over the variants
    leak: LeakScores  # `scores` less those of the controls, which have as many variants
    best: str  # the variant with the largest `LeakScores.evidence`, which is pictured and judged
    best_leak: LeakScores  # its scores less those of the controls
    picture: str | None = None  # name of a file, in an audit


@torch.no_grad()
def look_for_secret(
    stego: Gaussians,
    controls: Sequence[Gaussians],
    secret: Scene,
    attacks: Sequence[Attack],
    *,
    max_views: int = 8,
) -> tuple[list[AttackResult], dict[str, Tensor]]:
    """How well attacks show the secret, from its own test cameras, against its photos.

    The strictest assumption: the attacker looks from where the secret was photographed. `controls` are plain
    models of the cover; `secret` has its test cameras in the cover's frame (`keyss.measure.in_cover`), of
    which at most `max_views` are used. Images are uint8 [H, W, 3] by the attack's name: its best variant on
    the stego model and on the first control, from the first test camera, and the photo. Raises UsageError
    without a control or without test views.
    """
    if not controls:
        raise UsageError("leaks: expected at least one plain model of the cover to compare with")
    if not secret.test:
        raise UsageError(f"leaks: the scene {secret.name} has no test views")
    views = subsample_views(secret.test, max_views)

    def look(attack: Attack, model: Gaussians) -> dict[str, tuple[LeakScores, Tensor]]:
        """Scores of all variants of an attack, and pictures [H, W, 3] uint8 from the first view."""
        shown = {}
        for label, variant in attack.show(model):
            image = render(variant, views[0].camera, secret.background).clamp(0, 1)
            picture = (image * 255).round().to(torch.uint8).cpu()
            shown[label] = leak_scores(variant, views, secret.background), picture
        return shown

    results, pictures = [], {}
    for attack in attacks:
        variants = look(attack, stego)
        of_controls = [look(attack, model) for model in controls]
        highest = [LeakScores.combined(max, [each for each, _ in shown.values()]) for shown in of_controls]
        control = LeakScores.combined(fmean, highest)
        leaks = {label: own - control for label, (own, _) in variants.items()}
        best = max(leaks, key=lambda label: leaks[label].evidence())
        scored = LeakScores.combined(max, [own for own, _ in variants.values()])
        results.append(
            AttackResult(
                attack.name, attack.sentence, attack.with_key, scored, scored - control, best, leaks[best]
            )
        )
        pictures[attack.name] = _beside([variants[best][1], of_controls[0][best][1], views[0].image])
    return results, pictures


def _beside(images: Sequence[Tensor]) -> Tensor:
    """The images [H, W, 3] side by side, with white gaps."""
    return torch.cat([F.pad(image.cpu(), (0, 0, 0, _GAP), value=255) for image in images], dim=1)[:, :-_GAP]
