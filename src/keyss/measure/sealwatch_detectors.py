"""Detectors of the package sealwatch on renders: stronger and younger than StegExpose's.

SPA and WS estimate the rate of LSB replacement in a single image. SPAM with an ensemble of linear classifiers
learns from renders of both models, and so answers to any difference between them: two plain models of one
scene from two seeds differ as well. Its AUC means something only beside that of such a pair.

sealwatch is an optional dependency (`pip install 'keyss[steganalysis]'`, MPL-2.0). Its SPAM and its ensemble
follow code by Binghamton University's DDE Lab that is for education, research and non-profit use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from keyss.core.errors import BackendError, UsageError
from keyss.measure.roc import Image, Roc, check_same_views, roc

FOLDS = 5
LEAST_VIEWS = 10  # to learn anything from
LEAST_SIDE = 8  # pixels
_LEARNERS, _SUBSPACE = 51, 100  # searching for them, as sealwatch can, takes minutes and needs more views

Features = NDArray[np.float64]  # [N, 686]


@dataclass(frozen=True)
class DetectorRoc:
    """A detector on renders of the same views by two models; None for an image without an answer."""

    plain: tuple[float | None, ...]
    stego: tuple[float | None, ...]
    roc: Roc


@dataclass(frozen=True)
class SealwatchRocs:
    """What each of sealwatch's detectors makes of renders."""

    spa: DetectorRoc  # rate of embedding, mean over channels: Dumitrescu, Wu and Memon (2003)
    ws: DetectorRoc  # rate of changed pixels, mean over channels: Fridrich and Goljan (2004)
    # Votes in [-1, 1] of classifiers trained on other views; None for fewer than 10 views. Features: Pevny,
    # Bas and Fridrich (2010), 686 numbers; ensemble: Kodovsky, Fridrich and Holub (2012).
    spam: DetectorRoc | None


def sealwatch_roc(
    plain_images: Sequence[Image], stego_images: Sequence[Image], *, seed: int = 0
) -> SealwatchRocs:
    """SPA, WS and SPAM on renders of the same views by a plain and a stego model, [H, W, 3] uint8 each.

    SPAM is cross-validated in 5 runs of consecutive views, both renders of a view in the same: give views in
    the order of the camera's path.
    Raises BackendError where sealwatch is missing or broken, UsageError when the views are not the same in
    number or size, or smaller than 8 pixels.
    """
    check_same_views(plain_images, stego_images)
    for image in plain_images:
        if min(image.shape[:2]) < LEAST_SIDE:
            raise UsageError(f"expected images of at least {LEAST_SIDE}x{LEAST_SIDE}, got {image.shape[:2]}")
    sealwatch = _sealwatch()
    spa, ws = (
        _judged(*([_mean_rate(attack, image) for image in each] for each in (plain_images, stego_images)))
        for attack in (sealwatch.spa.attack, sealwatch.ws.attack)
    )
    spam = None
    if len(plain_images) >= LEAST_VIEWS:
        spam = _judged(
            *_held_out_votes(sealwatch, _spam(sealwatch, plain_images), _spam(sealwatch, stego_images), seed)
        )
    return SealwatchRocs(spa, ws, spam)


def _sealwatch() -> Any:
    try:
        import_module("torchvision")  # first: half a sealwatch in memory would spoil another try
        return import_module("sealwatch")
    except (ImportError, OSError, RuntimeError) as error:  # RuntimeError: a torchvision for another torch
        raise BackendError(
            "these detectors need the package sealwatch and the torchvision that belongs to this torch "
            f"(pip install 'keyss[steganalysis]'): {error}"
        ) from error


def _judged(plain: list[float | None], stego: list[float | None]) -> DetectorRoc:
    return DetectorRoc(tuple(plain), tuple(stego), roc(plain, stego))


def _mean_rate(attack: Callable[[NDArray[np.uint8]], float], image: Image) -> float | None:
    """Over the channels; None where the attack has no answer."""
    try:
        rate = float(np.mean([attack(channel) for channel in _channels(image)]))
    except ValueError:  # SPA's equation without a root
        return None
    return rate if math.isfinite(rate) else None


def _spam(sealwatch: Any, images: Sequence[Image]) -> Features:
    """Of each image, the mean over its channels."""
    with sealwatch.BACKEND_RUST:
        rows = [
            [sealwatch.tools.flatten(sealwatch.spam.extract(x)) for x in _channels(image)] for image in images
        ]
    features: Features = np.mean(rows, axis=1)
    return features


def _held_out_votes(
    sealwatch: Any, plain: Features, stego: Features, seed: int
) -> tuple[list[float | None], list[float | None]]:
    """Of the plain and of the stego views, each by an ensemble that learned from the other folds."""
    views = len(plain)
    fold_of = np.arange(views) * FOLDS // views
    votes = np.zeros((2, views))
    with threadpool_limits(1):  # such small matrices take several times as long on several threads
        for fold in range(FOLDS):
            held_out = fold_of == fold
            ensemble, _ = sealwatch.ensemble_classifier.FldEnsembleTrainer(
                plain[~held_out], stego[~held_out], seed=seed, L=_LEARNERS, d_sub=_SUBSPACE, verbose=0
            ).train()
            votes[0, held_out] = ensemble.predict_confidence(plain[held_out])
            votes[1, held_out] = ensemble.predict_confidence(stego[held_out])
    return votes[0].tolist(), votes[1].tolist()


def _channels(image: Image) -> list[NDArray[np.uint8]]:
    """Three [H, W], contiguous."""
    return [np.ascontiguousarray(image[:, :, channel]) for channel in range(3)]
