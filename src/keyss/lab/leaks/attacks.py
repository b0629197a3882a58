"""Attacks: changes of a model that may show a secret without its key.

Transparent Gaussians may belong to a secret (KeySS, figures 2 and 6). A second scene, stored in attributes
that do not affect renders (lengths of quaternions, harmonics of transparent Gaussians) or trained
differently, may form a cluster. Attacks do not change a model in place.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.channels import is_appended
from keyss.core import Camera, Gaussians, Scene, import_extra
from keyss.fitting.image_metrics import subsample_views
from keyss.keys import random_embeddings
from keyss.keys.derivation import EMBEDDING_SIZE
from keyss.rendering import contributions

OPAQUE = 0.99  # the maximum alpha of a Gaussian in 3DGS
THRESHOLDS = (0.01, 0.05, 0.2)  # opacities; the paper's figures use 0.05
SHARES = (0.1, 0.3, 0.5)  # fractions of the Gaussians, least contributing first
DEVIATIONS = (2.0, 3.5)  # robust z-scores of outliers
CLUSTERS = (2, 4)
SEARCH_SAMPLE = 1000  # Gaussians used to search embeddings; more do not change the result

_TO_SIGMA = 1.4826  # converts a median absolute deviation to a normal standard deviation
_MIN_SPREAD = 1e-3  # log units: attributes that differ only by rounding have no outliers
_MIN_LENGTH = 1e-12
_CLUSTER_SAMPLE = 5000  # Gaussians used to find clusters
_MIN_CLUSTERED = 10

Variants = Iterator[tuple[str, Gaussians]]  # labelled models to render
Decode = Callable[[Gaussians, Tensor], Gaussians]  # `keyss.methods.hidden.HiddenScene.decode`


@dataclass(frozen=True)
class Attack:
    """One attack: changes a model into labelled variants to render; labels do not depend on the model."""

    name: str
    sentence: str
    show: Callable[[Gaussians], Variants]


def file_attacks(cover: Scene, *, cover_views: int = 32, seed: int = 0) -> list[Attack]:
    """Attacks with the published file and photos of the cover: at most `cover_views` training views."""
    cameras = [view.camera for view in subsample_views(cover.train, cover_views)]
    return [
        Attack(
            "restored opacities",
            "Gaussians below an opacity are made opaque and the others left out, or all made opaque.",
            _below_thresholds,
        ),
        Attack(
            "matched opacities",
            "Gaussians below an opacity alone, with the opacities of the others, given by rank.",
            _match_opacities,
        ),
        Attack(
            "least contribution",
            "The Gaussians that add least to the cover's views are made opaque, the others left out.",
            partial(_least_contributing, cameras),
        ),
        *(
            Attack(
                f"outliers in {attribute}",
                f"Gaussians of unusual {attribute} are made opaque, the others left out.",
                partial(_outliers, attribute),
            )
            for attribute in ATTRIBUTES
        ),
        Attack(
            "clusters",
            "Groups of similar attributes (a mixture of normal distributions), each alone and made opaque.",
            partial(_clusters, seed),
        ),
    ]


def decoder_attack(
    decode: Decode, key_size: int = EMBEDDING_SIZE, *, restarts: int = 2, steps: int = 150, seed: int = 0
) -> Attack:
    """The attack with a secret's decoder, but without the key.

    `decode`: see `HiddenScene`; without a gradient in the embedding, the search is random.
    """

    def show(model: Gaussians) -> Variants:
        generator = torch.Generator().manual_seed(seed)
        embeddings = {"random": random_embeddings(restarts, generator, key_size)}
        for name, balance in (("most exchange", 2.0), ("most change", 0.0)):
            embeddings[name] = search_embeddings(
                decode, model, key_size, restarts=restarts, steps=steps, balance=balance, seed=seed
            )
        for name, vectors in embeddings.items():
            for index, embedding in enumerate(vectors, start=1):
                yield f"{name}, {index}", decode(model, embedding)

    return Attack(
        "decoder without its key",
        "Random embeddings, and those under which the decoder changes most, searched by gradient.",
        show,
    )


@torch.enable_grad()
def search_embeddings(
    decode: Decode,
    stego: Gaussians,
    key_size: int = EMBEDDING_SIZE,
    *,
    restarts: int = 8,
    steps: int = 150,
    balance: float = 2.0,
    seed: int = 0,
) -> Tensor:
    """[restarts, key_size] unit vectors that change opacities most, best first.

    In the published scheme, the key is a vector that enters the decoder's first layers. An attacker with the
    network can search for the vector that exchanges most Gaussians: by gradient ascent from random starts, on
    the mean absolute change of the opacities minus `balance` times the absolute change of their mean. Making
    some Gaussians visible and others invisible replaces a scene; only adding or removing them does not.
    `balance=0` counts all changes, and finds secrets with more Gaussians than the cover.

    Decodes a random subset of SEARCH_SAMPLE Gaussians, without appended ones. Returns the random starts if
    the decoded opacities have no gradient in the embedding.
    """
    generator = torch.Generator().manual_seed(seed)
    part = stego.detach()[~is_appended(stego)]
    if len(part) > SEARCH_SAMPLE:
        part = part[torch.randperm(len(part), generator=generator)[:SEARCH_SAMPLE].to(stego.device)]

    def exchange(direction: Tensor) -> Tensor:
        change = decode(part, F.normalize(direction, dim=0)).opacities - part.opacities
        return change.abs().mean() - balance * change.mean().abs()

    starts = random_embeddings(restarts, generator, key_size)
    if not exchange(starts[0].to(stego.device).requires_grad_()).requires_grad:
        return starts
    scored = []
    for start in starts:
        direction = start.to(stego.device).requires_grad_()
        optimizer = torch.optim.Adam([direction], lr=0.02)
        for _ in range(steps):
            optimizer.zero_grad()
            (-exchange(direction)).backward()
            optimizer.step()
        with torch.no_grad():
            scored.append((float(exchange(direction)), F.normalize(direction.detach(), dim=0).cpu()))
    scored.sort(key=lambda pair: -pair[0])
    return torch.stack([embedding for _, embedding in scored])


def _make_opaque(model: Gaussians) -> Gaussians:
    """Set all opacities to OPAQUE."""
    logit = math.log(OPAQUE / (1 - OPAQUE))
    return replace(model, opacity_logits=torch.full_like(model.opacity_logits, logit))


def _below_thresholds(model: Gaussians) -> Variants:
    """The Gaussians below each threshold alone, and the whole model, made opaque."""
    for threshold in THRESHOLDS:
        yield f"below {threshold}", _make_opaque(model[model.opacities < threshold])
    yield "all", _make_opaque(model)


def _match_opacities(model: Gaussians) -> Variants:
    """Give the Gaussians below each threshold the opacities of the others, by rank.

    Undoes any monotone reduction of opacities.
    """
    for threshold in THRESHOLDS:
        below = model.opacities < threshold
        part, others = model[below], model.opacity_logits[~below].sort().values
        if len(part) and len(others):
            ranks = part.opacity_logits.argsort().argsort()
            rows = ((ranks + 0.5) * (len(others) / len(part))).long().clamp(max=len(others) - 1)
            part = replace(part, opacity_logits=others[rows])
        yield f"below {threshold}", part


def _least_contributing(cameras: Sequence[Camera], model: Gaussians) -> Variants:
    """The Gaussians that contribute least to the cameras' images, made opaque."""
    order = contributions(model, cameras).argsort(stable=True)
    for share in SHARES:
        yield f"{share:.0%}", _make_opaque(model[order[: round(share * len(model))]])


def _quaternion_length(model: Gaussians) -> Tensor:
    """[N] natural logarithm of the length."""
    length: Tensor = model.quats.norm(dim=1).clamp_min(_MIN_LENGTH).log()
    return length


def _sh_energy(model: Gaussians) -> Tensor:
    """[N] natural logarithm of the sum of squares of the harmonics above the constant one."""
    return model.sh[:, 1:].square().sum((1, 2)).clamp_min(_MIN_LENGTH).log()


ATTRIBUTES: dict[str, Callable[[Gaussians], Tensor]] = {
    "quaternion length": _quaternion_length,
    "scale": lambda model: model.log_scales.mean(dim=1),
    "SH energy": _sh_energy,
}


def _outliers(attribute: str, model: Gaussians) -> Variants:
    """The Gaussians whose robust z-score in an attribute is beyond a limit, made opaque.

    The score is (value - median) / standard deviation, estimated by the median absolute deviation.
    """
    score = ATTRIBUTES[attribute](model)
    if len(model):
        score = score - score.median()
        score = score / (_TO_SIGMA * score.abs().median()).clamp_min(_MIN_SPREAD)
    for side, sign in (("low", -1), ("high", 1)):
        for deviation in DEVIATIONS:
            yield f"{side}, {deviation} deviations", _make_opaque(model[sign * score > deviation])


def _clusters(seed: int, model: Gaussians) -> Variants:
    """Clusters of similar Gaussians, each alone and made opaque, largest first.

    A Gaussian mixture of opacity logit, sorted log scales, constant colour, and logarithms of quaternion
    length and SH energy, all standardised; positions would cut the scene into pieces. A model of fewer than
    ten Gaussians is one cluster; the others are empty.
    """
    for count in CLUSTERS:
        labels = torch.zeros(len(model), dtype=torch.long)
        if len(model) >= _MIN_CLUSTERED:
            labels = _cluster_labels(model, count, seed)
        order = torch.bincount(labels, minlength=count).argsort(descending=True, stable=True)
        for index, label in enumerate(order, start=1):
            yield f"{index} of {count}", _make_opaque(model[(labels == label).to(model.device)])


def _cluster_labels(model: Gaussians, count: int, seed: int) -> Tensor:
    """[N] the cluster of each Gaussian, on the CPU."""
    columns = [
        model.opacity_logits[:, None],
        model.log_scales.sort(dim=1).values,
        model.sh[:, 0],
        _quaternion_length(model)[:, None],
        _sh_energy(model)[:, None],
    ]
    features = torch.cat(columns, dim=1)
    spread = features.std(dim=0, correction=0).clamp_min(_MIN_SPREAD)
    rows = ((features - features.mean(dim=0)) / spread).cpu().double().numpy()
    sample = np.random.default_rng(seed).permutation(len(rows))[:_CLUSTER_SAMPLE]
    mixtures = import_extra("sklearn.mixture", "audit", "find clusters")
    threadpoolctl = import_extra("threadpoolctl", "audit", "find clusters")
    mixture = mixtures.GaussianMixture(count, reg_covar=1e-3, random_state=seed)
    # For 9 x 9 matrices, starting threads takes a hundred times as long as the work.
    with threadpoolctl.threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a mixture that has not converged is good enough
        mixture.fit(rows[sample])
    return torch.from_numpy(mixture.predict(rows))
