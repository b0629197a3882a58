"""Looking for a secret without its key, and how much of what is seen is the secret's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.leaks.attacks import Attack, decoder_attacks, file_attacks
from keyss.measure.leaks.scores import SCORES, scores
from keyss.methods.learned.payload import HiddenSecret
from keyss.rendering import render

_GAP = 4  # pixels between the parts of a picture
_JUDGE = "gradient_coarse"  # the score by which the view that a picture shows is chosen


def look_for_secret(
    stego: Gaussians,
    plains: Sequence[Gaussians],
    cover: Scene,
    secret: Scene,
    frame: Similarity,
    *,
    opened: HiddenSecret | None = None,
    test_views: int = 8,
    cover_views: int = 32,
    restarts: int = 2,
    seed: int = 0,
) -> tuple[list[dict[str, Any]], dict[str, Tensor]]:
    """Every attack on one secret: rows for JSON, and a picture of each by its name.

    `stego` and `plains`, one or more plain models of the cover, are in the cover's frame, `cover` and
    `secret` in their own, and `frame` leads from the secret's into the cover's. `opened` adds the attack on
    an unsealed decoder, and what the key shows. Of the secret's test views at most `test_views` are used and
    of the cover's training views `cover_views`, evenly spread; `restarts` are those of each search on a
    decoder. See `attack` for what comes back. Raises UsageError for no plain model and for a secret without
    test views.
    """
    attacks = file_attacks([view.camera for view in subsample_views(cover.train, cover_views)], seed)
    if opened is not None:
        attacks += decoder_attacks(opened, restarts=restarts, seed=seed)
    return attack(stego, plains, secret, frame, attacks, test_views=test_views)


def attack(
    stego: Gaussians,
    plains: Sequence[Gaussians],
    secret: Scene,
    frame: Similarity,
    attacks: Sequence[Attack],
    *,
    test_views: int = 8,
) -> tuple[list[dict[str, Any]], dict[str, Tensor]]:
    """How well attacks show the secret, seen from its own test cameras where it lies, against its photos.

    The strictest assumption: the attacker stands where the secret was photographed. For each attack a row:

    - attack, sentence, parameters, control: see `Attack`.
    - views: how many the attacker looks at; best: the one with the largest `gradient_coarse`.
    - SCORES (`scores`), each the largest over the attack's views, for the attacker knows when he sees it.
    - null: the same numbers on the plain models, their mean, and null_max the largest of any.
    - leak: the differences from the mean. More views are thus no more leak.

    And pictures uint8 [H, W, 3]: the best view, from the first test camera, of stego and of the first
    plain model, and the photo.
    """
    if not plains:
        raise UsageError("leaks: expected at least one plain model of the cover to compare with")
    if not secret.test:
        raise UsageError(f"leaks: the scene {secret.name} has no test views")
    chosen = subsample_views(secret.test, test_views)
    views = [View(frame.apply_camera(view.camera), view.image) for view in chosen]
    rows, pictures = [], {}
    for each in attacks:
        found = _look(each, stego, views, secret.background)
        nulls = [_look(each, plain, views, secret.background, found.label) for plain in plains]
        null = {name: sum(n.scores[name] for n in nulls) / len(nulls) for name in SCORES}
        rows.append(
            {
                "attack": each.name,
                "sentence": each.sentence,
                "parameters": each.parameters,
                "control": each.control,
                "views": found.count,
                "best": found.label,
                **found.scores,
                "null": null,
                "null_max": {name: max(n.scores[name] for n in nulls) for name in SCORES},
                "leak": {name: found.scores[name] - null[name] for name in SCORES},
            }
        )
        pictures[each.name] = _beside([found.picture, nulls[0].picture, views[0].image])
    return rows, pictures


@dataclass(frozen=True)
class _Found:
    """What an attack shows of one model."""

    scores: dict[str, float]  # each the largest over all that is shown
    count: int  # of what is shown
    label: str  # of what `picture` shows
    picture: Tensor  # [H, W, 3] uint8


@torch.no_grad()
def _look(
    attack: Attack, model: Gaussians, views: Sequence[View], background: Tensor, label: str | None = None
) -> _Found:
    """Look at all that the attack shows; the picture is of `label`, or of what shows most."""
    rows: list[dict[str, float]] = []
    pictured: tuple[str, Gaussians] | None = None
    for name, shown in attack.show(model):
        rows.append(scores(shown, views, background))
        best = rows[-1][_JUDGE] == max(row[_JUDGE] for row in rows)
        if pictured is None or (best if label is None else name == label):
            pictured = name, shown
    assert pictured is not None
    image = render(pictured[1], views[0].camera, background)
    return _Found(
        {name: max(row[name] for row in rows) for name in SCORES},
        len(rows),
        pictured[0],
        (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu(),
    )


def _beside(images: Sequence[Tensor]) -> Tensor:
    """The images [H, W, 3] in a row, with white between."""
    gap = torch.full((images[0].shape[0], _GAP, 3), 255, dtype=torch.uint8)
    parts = [part for image in images for part in (gap, image.cpu())]
    return torch.cat(parts[1:], dim=1)
