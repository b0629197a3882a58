"""Attacks by name: changes of a model that may show a secret without its key."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.channels import is_appended
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.keys import random_embeddings
from keyss.measure.leaks import views
from keyss.rendering import contributions

THRESHOLDS = (0.01, 0.05, 0.2)  # of opacities; the paper's figures use 0.05
SHARES = (0.1, 0.3, 0.5)  # of the least contributing
DEVIATIONS = (2.0, 3.5)  # robust z-scores of outliers
CLUSTERS = (2, 4)
SEARCH_SAMPLE = 1000  # Gaussians used to search embeddings; more do not change the result

Shown = Iterator[tuple[str, Gaussians]]
Decode = Callable[[Gaussians, Tensor], Gaussians]  # `keyss.methods.base.Opened.decode`
Parameter = str | int | float | list[float]


@dataclass(frozen=True)
class Attack:
    """One attack: makes models to render, with the same labels for every model."""

    name: str
    sentence: str
    parameters: dict[str, Parameter]
    show: Callable[[Gaussians], Shown]  # labelled models to render, one per variant
    with_key: bool = False  # not an attack, but the reference: the revealed secret


def file_attacks(cover: Scene, *, cover_views: int = 32, seed: int = 0) -> list[Attack]:
    """Attacks with the published file and photos of the cover: at most `cover_views` training views."""
    cameras = [view.camera for view in subsample_views(cover.train, cover_views)]
    return [
        Attack(
            "restored opacities",
            "Gaussians below an opacity are made opaque and the others left out, or all made opaque.",
            {"thresholds": list(THRESHOLDS)},
            _of_faint(views.opaque, also_of_all=True),
        ),
        Attack(
            "rescaled opacities",
            "Gaussians below an opacity alone, all opacities multiplied by one factor.",
            {"thresholds": list(THRESHOLDS)},
            _of_faint(views.rescaled),
        ),
        Attack(
            "matched opacities",
            "Gaussians below an opacity alone, with the opacities of the others, given by rank.",
            {"thresholds": list(THRESHOLDS)},
            lambda model: ((f"below {t}", views.matched(model, t)) for t in THRESHOLDS),
        ),
        Attack(
            "inverted opacities",
            "Opacities o become 1 - o, of Gaussians below an opacity alone or of all.",
            {"thresholds": list(THRESHOLDS)},
            _of_faint(views.inverted, also_of_all=True),
        ),
        Attack(
            "least contribution",
            "The Gaussians that add least to the cover's views are made opaque, the others left out.",
            {"shares": list(SHARES), "views": len(cameras)},
            lambda model: _least_contributing(model, cameras),
        ),
        *(_outliers(attribute) for attribute in get_args(views.Attribute)),
        Attack(
            "clusters",
            "Groups of like attributes (a mixture of normal distributions), each alone and made opaque.",
            {"clusters": list(CLUSTERS), "seed": seed},
            lambda model: _clusters(model, seed),
        ),
    ]


def decoder_attack(decode: Decode, *, restarts: int = 2, steps: int = 150, seed: int = 0) -> Attack:
    """The attack with a secret's decoder and everything encrypted with it, but without the key.

    `decode`: see `keyss.methods.base.Opened`. Without a gradient in the embedding, the search is random.
    """

    def show(model: Gaussians) -> Shown:
        found = {"random": random_embeddings(restarts, torch.Generator().manual_seed(seed))}
        for name, balance in (("most exchange", 2.0), ("most change", 0.0)):
            search = partial(search_embeddings, decode, model, limit=SEARCH_SAMPLE, balance=balance)
            found[name] = search(restarts=restarts, steps=steps, seed=seed)
        for name, embeddings in found.items():
            for index, embedding in enumerate(embeddings, start=1):
                yield f"{name}, {index}", decode(model, embedding)

    return Attack(
        "decoder without its key",
        "Random embeddings, and those under which the decoder changes most, searched by gradient.",
        {"restarts": restarts, "steps": steps, "seed": seed},
        show,
    )


@torch.enable_grad()
def search_embeddings(
    decode: Decode,
    stego: Gaussians,
    *,
    restarts: int = 8,
    steps: int = 150,
    limit: int = 4000,
    balance: float = 2.0,
    seed: int = 0,
) -> Tensor:
    """[restarts, 64] unit vectors for which the decoder seems to show another scene, the best first.

    In the published scheme the key is a vector that enters the decoder's first layers. Whoever has the
    network can search for the vector that exchanges most, without knowing the secret: gradient ascent from
    random starts on the mean change of the opacities, less `balance` times the change of their mean. Making
    some Gaussians visible and as many others invisible replaces one scene by another; only adding or removing
    does not. `balance=0` counts all change, which finds a secret that needs more Gaussians than the cover.

    A random subset of `limit` Gaussians is decoded; appended Gaussians, which no decoder changes, are
    ignored. Returns the random starts if the decoded opacities have no gradient in the embedding.
    """
    generator = torch.Generator().manual_seed(seed)
    part = stego.detach()[~is_appended(stego)]
    if len(part) > limit:
        part = part[torch.randperm(len(part), generator=generator)[:limit].to(stego.device)]

    def exchanged(direction: Tensor) -> Tensor:
        change = decode(part, F.normalize(direction, dim=0)).opacities - part.opacities
        score: Tensor = change.abs().mean() - balance * change.mean().abs()
        return score

    starts = random_embeddings(restarts, generator)
    if not exchanged(starts[0].to(stego.device).requires_grad_()).requires_grad:
        return starts
    found = []
    for start in starts:
        direction = start.to(stego.device).requires_grad_()
        optimizer = torch.optim.Adam([direction], lr=0.02)
        for _ in range(steps):
            optimizer.zero_grad()
            (-exchanged(direction)).backward()
            optimizer.step()
        with torch.no_grad():
            found.append((float(exchanged(direction)), F.normalize(direction.detach(), dim=0).cpu()))
    found.sort(key=lambda pair: -pair[0])
    return torch.stack([embedding for _, embedding in found])


def with_the_key(reveal: Callable[[Gaussians], Gaussians]) -> Attack:
    """The reference: the secret in the cover's frame, as its key reveals it."""
    return Attack(
        "with the key",
        "Not an attack: what there is to find.",
        {},
        lambda model: iter([("revealed", reveal(model))]),
        with_key=True,
    )


def _of_faint(
    change: Callable[[Gaussians], Gaussians], *, also_of_all: bool = False
) -> Callable[[Gaussians], Shown]:
    """Applies a change to the Gaussians below each threshold, and optionally to all."""

    def show(model: Gaussians) -> Shown:
        for threshold in THRESHOLDS:
            yield f"below {threshold}", change(views.faint(model, threshold))
        if also_of_all:
            yield "all", change(model)

    return show


def _least_contributing(model: Gaussians, cameras: Sequence[Camera]) -> Shown:
    weights = contributions(model, cameras)
    for share in SHARES:
        yield f"{share:.0%}", views.opaque(views.least_contributing(model, weights, share))


def _outliers(attribute: views.Attribute) -> Attack:
    def show(model: Gaussians) -> Shown:
        for side, deviation in product(get_args(views.Side), DEVIATIONS):
            yield f"{side}, {deviation} deviations", views.outliers(model, attribute, side, deviation)

    return Attack(
        f"outliers in {attribute}",
        f"Gaussians of unusual {attribute} are made opaque, the others left out.",
        {"deviations": list(DEVIATIONS)},
        show,
    )


def _clusters(model: Gaussians, seed: int) -> Shown:
    for count in CLUSTERS:
        for index, part in enumerate(views.clusters(model, count, seed), start=1):
            yield f"{index} of {count}", part
