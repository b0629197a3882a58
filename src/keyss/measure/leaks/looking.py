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

    Scores are each the largest over the attack's views, for the attacker knows when he sees it.
    """

    attack: str
    sentence: str
    parameters: dict[str, Parameter]
    with_key: bool  # no attack: shows what there is to find
    views: int  # that the attacker looks at
    best: str  # the view with the largest `gradient_coarse`
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
    [H, W, 3], by the attack's name: the best view, from the first test camera, of stego and of the first
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
        found, count, label, picture = _look(each, stego, views, secret.background)
        innocent = [_look(each, model, views, secret.background, label) for model in controls]
        control = LeakScores.combined(fmean, [one for one, *_ in innocent])
        results.append(
            AttackResult(
                each.name,
                each.sentence,
                each.parameters,
                each.with_key,
                count,
                label,
                found,
                control,
                LeakScores.combined(max, [one for one, *_ in innocent]),
                found - control,
            )
        )
        pictures[each.name] = _beside([picture, innocent[0][-1], views[0].image])
    return results, pictures


@torch.no_grad()
def _look(
    attack: Attack, model: Gaussians, views: Sequence[View], background: Tensor, label: str | None = None
) -> tuple[LeakScores, int, str, Tensor]:
    """Look at all that the attack shows of a model: the largest scores, and how many views there are.

    And a picture [H, W, 3] uint8 of the view called `label`, or of the one that shows most, with its label.
    """
    rows: list[LeakScores] = []
    pictured: tuple[str, Gaussians] | None = None
    for name, shown in attack.show(model):
        rows.append(scores(shown, views, background))
        best = rows[-1].gradient_coarse == max(row.gradient_coarse for row in rows)
        if pictured is None or (best if label is None else name == label):
            pictured = name, shown
    assert pictured is not None
    name, shown = pictured
    image = render(shown, views[0].camera, background).clamp(0, 1)
    return LeakScores.combined(max, rows), len(rows), name, (image * 255).round().to(torch.uint8).cpu()


def _beside(images: Sequence[Tensor]) -> Tensor:
    """The images [H, W, 3] in a row, with white between."""
    return torch.cat([F.pad(image.cpu(), (0, 0, 0, _GAP), value=255) for image in images], dim=1)[:, :-_GAP]
