"""Looking for a secret without its key, and how much of what is seen is the secret's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.leaks.attacks import Attack, Parameter
from keyss.measure.leaks.scores import LeakScores, scores
from keyss.rendering import render

_GAP = 4  # pixels between the parts of a picture


@dataclass(frozen=True)
class AttackResult:
    """What an attack shows of a secret, beside what it shows of control models.

    An attack has variants: thresholds, shares, clusters. Scores are each the largest over them, for the
    attacker knows when he sees it; `best` is the one variant that shows most of the secret's shapes.
    """

    attack: str
    sentence: str
    parameters: dict[str, Parameter]
    with_key: bool  # no attack: shows what there is to find
    views: int  # variants that the attacker looks at
    best: str  # the variant with the largest `LeakScores.evidence`: it is pictured, and gets the verdict
    best_leak: LeakScores  # its scores less `control`
    scores: LeakScores
    control: LeakScores  # the same on the control models, their mean
    control_max: LeakScores  # the largest on any of them
    leak: LeakScores  # `scores` less `control`: more views are thus no more leak
    picture: str | None = None  # name of a file, in an audit


def look_for_secret(
    stego: Gaussians,
    controls: Sequence[Gaussians],
    secret: Scene,
    frame: Similarity,
    attacks: Sequence[Attack],
    *,
    test_views: int = 8,
) -> tuple[list[AttackResult], dict[str, Tensor]]:
    """How well attacks show the secret, seen from its own test cameras where it lies, against its photos.

    `stego` and `controls`, one or more plain models of the cover, are in the cover's frame, `secret` in its
    own, and `frame` leads from there into the cover's. Of the test views at most `test_views` are used. The
    strictest assumption: the attacker stands where the secret was photographed. Pictures are uint8
    [H, W, 3], by the attack's name: its best variant, from the first test camera, of stego and of the first
    control, and the photo. Raises UsageError for no control and for a secret without test views.
    """
    if not controls:
        raise UsageError("leaks: expected at least one plain model of the cover to compare with")
    if not secret.test:
        raise UsageError(f"leaks: the scene {secret.name} has no test views")
    views = [
        View(frame.apply_camera(view.camera), view.image) for view in subsample_views(secret.test, test_views)
    ]
    results, pictures = [], {}
    for each in attacks:
        found = _look(each, stego, views, secret.background)
        innocent = [_look(each, model, views, secret.background) for model in controls]
        highest = [LeakScores.combined(max, [variant.scores for variant in one]) for one in innocent]
        control = LeakScores.combined(fmean, highest)
        best = max(found, key=lambda variant: (variant.scores - control).evidence())
        scored = LeakScores.combined(max, [variant.scores for variant in found])
        results.append(
            AttackResult(
                attack=each.name,
                sentence=each.sentence,
                parameters=each.parameters,
                with_key=each.with_key,
                views=len(found),
                best=best.label,
                best_leak=best.scores - control,
                scores=scored,
                control=control,
                control_max=LeakScores.combined(max, highest),
                leak=scored - control,
            )
        )
        same = next((variant for variant in innocent[0] if variant.label == best.label), innocent[0][0])
        pictures[each.name] = _beside([best.picture, same.picture, views[0].image])
    return results, pictures


@dataclass(frozen=True)
class _Variant:
    """One of the things that an attack makes of a model."""

    label: str
    scores: LeakScores
    picture: Tensor  # [H, W, 3] uint8, from the first view


@torch.no_grad()
def _look(attack: Attack, model: Gaussians, views: Sequence[View], background: Tensor) -> list[_Variant]:
    """All that the attack shows of a model."""
    found = []
    for label, shown in attack.show(model):
        image = render(shown, views[0].camera, background).clamp(0, 1)
        picture = (image * 255).round().to(torch.uint8).cpu()
        found.append(_Variant(label, scores(shown, views, background), picture))
    return found


def _beside(images: Sequence[Tensor]) -> Tensor:
    """The images [H, W, 3] in a row, with white between."""
    return torch.cat([F.pad(image.cpu(), (0, 0, 0, _GAP), value=255) for image in images], dim=1)[:, :-_GAP]
