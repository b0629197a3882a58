"""The attacks, by name: everything that somebody without the key would look at, of any model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import get_args

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.keys import random_embeddings
from keyss.measure.leaks.attributes import Attribute, Side, clusters, outliers
from keyss.measure.leaks.opacities import (
    faint,
    inverted,
    least_contributing,
    matched,
    opaque,
    rescaled,
)
from keyss.measure.white_box import search_embeddings
from keyss.rendering.contributions import contributions

THRESHOLDS = (0.01, 0.05, 0.2)  # of opacities; the paper's figures have 0.05
SHARES = (0.1, 0.3, 0.5)  # of the least contributing
DEVIATIONS = (2.0, 3.5)  # robust z-scores of outliers
CLUSTERS = (2, 4)
SEARCH_SAMPLE = 1000  # Gaussians that embeddings are searched on; more find no other

Shown = Iterator[tuple[str, Gaussians]]
Decode = Callable[[Gaussians, Tensor], Gaussians]
Parameter = str | int | float | list[float]


@dataclass(frozen=True)
class Attack:
    """Something to try on a model: it gives models to render, the same labels for every model."""

    name: str
    sentence: str
    parameters: dict[str, Parameter]
    show: Callable[[Gaussians], Shown]  # labels and what is rendered, as many as somebody would try
    with_key: bool = False  # no attack: shows what there is to find


def file_attacks(cover_cameras: Sequence[Camera], seed: int = 0) -> list[Attack]:
    """The attacks of somebody who has the published file, and photos of the cover from these cameras."""
    return [
        Attack(
            "restored opacities",
            "Gaussians below an opacity are made opaque and the others left out, or all made opaque.",
            {"thresholds": list(THRESHOLDS)},
            _restored,
        ),
        Attack(
            "rescaled opacities",
            "Gaussians below an opacity alone, all opacities multiplied by one factor.",
            {"thresholds": list(THRESHOLDS)},
            lambda model: ((_below(t), rescaled(faint(model, t))) for t in THRESHOLDS),
        ),
        Attack(
            "matched opacities",
            "Gaussians below an opacity alone, with the opacities of the others, given by rank.",
            {"thresholds": list(THRESHOLDS)},
            lambda model: ((_below(t), matched(model, t)) for t in THRESHOLDS),
        ),
        Attack(
            "inverted opacities",
            "Opacities o become 1 - o, of Gaussians below an opacity alone or of all.",
            {"thresholds": list(THRESHOLDS)},
            _inverted,
        ),
        Attack(
            "least contribution",
            "The Gaussians that add least to the cover's views are made opaque, the others left out.",
            {"shares": list(SHARES), "views": len(cover_cameras)},
            lambda model: _least_contributing(model, cover_cameras),
        ),
        *(_outliers(attribute) for attribute in get_args(Attribute)),
        Attack(
            "clusters",
            "Groups of like attributes (a mixture of normal distributions), each alone and made opaque.",
            {"clusters": list(CLUSTERS), "seed": seed},
            lambda model: _clusters(model, seed),
        ),
    ]


def source_attack(views: Callable[[Gaussians], Mapping[str, Gaussians]]) -> Attack:
    """The attack of somebody who read the source of the methods: `keyss.methods.base.Method.attacks`.

    `views` gives the same names for every model.
    """
    return Attack(
        "by the source",
        "What this program's source tells somebody to try.",
        {},
        lambda model: iter(views(model).items()),
    )


def decoder_attack(decode: Decode, *, restarts: int = 2, steps: int = 150, seed: int = 0) -> Attack:
    """What somebody sees who got a secret's decoder and all that is encrypted with it, but not the key.

    `decode`: see `keyss.methods.base.Opened`. Where embeddings get no gradient, the search shows no more than
    random embeddings do.
    """

    def search(model: Gaussians) -> Shown:
        found = {"random": random_embeddings(restarts, torch.Generator().manual_seed(seed))}
        for name, balance in (("most exchange", 2.0), ("most change", 0.0)):
            found[name] = search_embeddings(
                decode,
                model,
                restarts=restarts,
                steps=steps,
                most=SEARCH_SAMPLE,
                balance=balance,
                seed=seed,
            )
        for name, embeddings in found.items():
            for index, embedding in enumerate(embeddings, start=1):
                yield f"{name}, {index}", decode(model, embedding)

    return Attack(
        "decoder without its key",
        "Random embeddings, and those under which the decoder changes most, searched by gradient.",
        {"restarts": restarts, "steps": steps, "seed": seed},
        search,
    )


def with_the_key(reveal: Callable[[Gaussians], Gaussians]) -> Attack:
    """What there is to find: the secret in the cover's frame, as its key reveals it in a model."""
    return Attack(
        "with the key",
        "No attack: what there is to find.",
        {},
        lambda model: iter([("revealed", reveal(model))]),
        with_key=True,
    )


def _restored(model: Gaussians) -> Shown:
    for threshold in THRESHOLDS:
        yield _below(threshold), opaque(faint(model, threshold))
    yield "all", opaque(model)


def _inverted(model: Gaussians) -> Shown:
    for threshold in THRESHOLDS:
        yield _below(threshold), inverted(faint(model, threshold))
    yield "all", inverted(model)


def _least_contributing(model: Gaussians, cameras: Sequence[Camera]) -> Shown:
    weights = contributions(model, cameras)
    for share in SHARES:
        yield f"{share:.0%}", opaque(least_contributing(model, weights, share))


def _outliers(attribute: Attribute) -> Attack:
    def show(model: Gaussians) -> Shown:
        for side, deviation in product(get_args(Side), DEVIATIONS):
            yield f"{side}, {deviation} deviations", outliers(model, attribute, side, deviation)

    return Attack(
        f"outliers in {attribute}",
        f"Gaussians of unusual {attribute} are made opaque, the others left out.",
        {"deviations": list(DEVIATIONS)},
        show,
    )


def _clusters(model: Gaussians, seed: int) -> Shown:
    for count in CLUSTERS:
        for index, part in enumerate(clusters(model, count, seed), start=1):
            yield f"{index} of {count}", part


def _below(threshold: float) -> str:
    return f"below {threshold}"
