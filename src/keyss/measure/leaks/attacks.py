"""The attacks, by name: everything that somebody without the key would look at, of any model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.channels.appended import is_appended
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.keys import random_embeddings
from keyss.measure.leaks import views
from keyss.rendering.contributions import contributions

THRESHOLDS = (0.01, 0.05, 0.2)  # of opacities; the paper's figures have 0.05
SHARES = (0.1, 0.3, 0.5)  # of the least contributing
DEVIATIONS = (2.0, 3.5)  # robust z-scores of outliers
CLUSTERS = (2, 4)
SEARCH_SAMPLE = 1000  # Gaussians that embeddings are searched on; more find no other

Shown = Iterator[tuple[str, Gaussians]]
Decode = Callable[[Gaussians, Tensor], Gaussians]  # `keyss.methods.base.Opened.decode`
Parameter = str | int | float | list[float]


@dataclass(frozen=True)
class Attack:
    """Something to try on a model: it gives models to render, the same labels for every model."""

    name: str
    sentence: str
    parameters: dict[str, Parameter]
    show: Callable[[Gaussians], Shown]  # labels and what is rendered, as many as somebody would try
    with_key: bool = False  # no attack: shows what there is to find


def file_attacks(cover: Scene, *, cover_views: int = 32, seed: int = 0) -> list[Attack]:
    """The attacks of somebody who has the published file, and photos of the cover.

    Of its training views at most `cover_views` are used, evenly spread.
    """
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
    """What somebody sees who got a secret's decoder and all that is encrypted with it, but not the key.

    `decode`: see `keyss.methods.base.Opened`. Where embeddings get no gradient, the search shows no more than
    random embeddings do.
    """

    def show(model: Gaussians) -> Shown:
        found = {"random": random_embeddings(restarts, torch.Generator().manual_seed(seed))}
        for name, balance in (("most exchange", 2.0), ("most change", 0.0)):
            search = partial(search_embeddings, decode, model, most=SEARCH_SAMPLE, balance=balance)
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
    most: int = 4000,
    balance: float = 2.0,
    seed: int = 0,
) -> Tensor:
    """[restarts, 64] unit vectors under which the decoder seems to show another scene, the best first.

    In the published scheme the key is a vector that enters the decoder's first layers. Whoever has the
    network can look for the vector under which it exchanges most, without any idea of the secret.
    Gradient ascent from random starts on the mean change of the opacities, less `balance` times the change of
    their mean: what makes some visible and as much of others invisible is a scene in place of a scene, while
    what only adds or only removes is not. With 0 all change counts, which finds a secret that needs more
    Gaussians than the cover. Of larger models a random subset of `most` Gaussians is decoded: a decoder that
    divides opacities by their norm over the model sees larger ones then, which are small all the same. What
    was appended to the model, no decoder changes: it is left out. Where the decoded opacities have no
    gradient in the embedding, the random starts come back.
    """
    generator = torch.Generator().manual_seed(seed)
    part = stego.detach()[~is_appended(stego)]
    if len(part) > most:
        part = part[torch.randperm(len(part), generator=generator)[:most].to(stego.device)]

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
    """What there is to find: the secret in the cover's frame, as its key reveals it in a model."""
    return Attack(
        "with the key",
        "No attack: what there is to find.",
        {},
        lambda model: iter([("revealed", reveal(model))]),
        with_key=True,
    )


def _of_faint(
    change: Callable[[Gaussians], Gaussians], *, also_of_all: bool = False
) -> Callable[[Gaussians], Shown]:
    """A change of the Gaussians below each opacity alone, and of all."""

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
