"""How well a score tells stego from plain: ROC curves, and StegExpose's on renders of the same views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from keyss.core.errors import UsageError

if TYPE_CHECKING:
    from keyss.measure.stegexpose import Scores

INTERVAL = "DeLong 1988, on the logit scale, 95 %"
_Z = 1.959963984540054  # standard normal quantile of 0.975

Score = float | None
Image = NDArray[np.uint8]  # [H, W, 3]


def roc(negatives: Sequence[Score], positives: Sequence[Score]) -> dict[str, Any]:
    """The ROC of scores that should be higher for positives: `auc`, its interval, `fpr` and `tpr`.

    `auc` in [0, 1]: how often a positive scores above a negative, ties counting half. `low` and `high`: 95 %
    interval, `interval` names how. `fpr`, `tpr`: corners of the curve, from (0, 0) to (1, 1). A score that is
    NaN or None is above no threshold, so it counts as lower than every number; `unanswered` has how many
    there are of both, and a detector that answers one class less often can so have an AUC far from 0.5. The
    interval takes all images for independent, which renders of neighbouring views are not: a small one means
    less than it seems. Raises UsageError where a class is empty.
    """
    from sklearn.metrics import roc_auc_score, roc_curve

    if not negatives or not positives:
        raise UsageError(f"expected scores of both classes, got {len(negatives)} and {len(positives)}")
    plain, stego = _numbers(negatives, positives)
    labels = np.repeat([0, 1], [len(plain), len(stego)])
    scores = np.concatenate([plain, stego])
    fpr, tpr, _ = roc_curve(labels, scores)
    auc = float(roc_auc_score(labels, scores))
    low, high = _interval(plain, stego)
    return {
        "auc": auc,
        "low": low,
        "high": high,
        "interval": INTERVAL,
        "fpr": fpr.tolist(),
        "tpr": tpr.tolist(),
        "unanswered": [_unanswered(negatives), _unanswered(positives)],
    }


def stegexpose_roc(plain_images: Sequence[Image], stego_images: Sequence[Image]) -> dict[str, Any]:
    """StegExpose on renders of the same views by a plain and by a stego model, [H, W, 3] uint8 each.

    `plain` and `stego`: the scores of each image, `fusion` among them, NaN as None; `roc`: of the fused ones;
    `detectors`: the AUC of each alone, None where it takes no image (Chi Square: less than about 87,700
    pixels; Sample Pairs: odd sizes).
    The AUC of a renderer's output should be near 0.5, whatever is hidden: no pixel's last bit is replaced.
    Raises UsageError when the views are not the same in number or size.
    """
    from keyss.measure.stegexpose import DETECTORS, score_image

    check_same_views(plain_images, stego_images)
    plain = [score_image(image) for image in plain_images]
    stego = [score_image(image) for image in stego_images]
    detectors: dict[str, float | None] = {}
    for name in DETECTORS:
        negatives, positives = ([getattr(scores, name) for scores in each] for each in (plain, stego))
        silent = all(map(_is_missing, negatives + positives))
        detectors[name] = None if silent else roc(negatives, positives)["auc"]
    rows = [[_row(scores) for scores in each] for each in (plain, stego)]
    fused = [[row["fusion"] for row in each] for each in rows]
    return {"plain": rows[0], "stego": rows[1], "roc": roc(*fused), "detectors": detectors}


def check_same_views(plain_images: Sequence[Image], stego_images: Sequence[Image]) -> None:
    """Raises UsageError when the images do not pair up in number and size, or when there are none."""
    sizes = [[list(image.shape[:2]) for image in images] for images in (plain_images, stego_images)]
    if not sizes[0] or sizes[0] != sizes[1]:
        raise UsageError(
            f"expected renders of the same views, got {len(sizes[0])} and {len(sizes[1])} images"
            + (" of different sizes" if len(sizes[0]) == len(sizes[1]) > 0 else "")
        )


def _interval(plain: NDArray[np.float64], stego: NDArray[np.float64]) -> tuple[float, float]:
    """DeLong, DeLong and Clarke-Pearson (1988) for the variance; Pepe (2003) for the logit scale.

    There is no variance to go by where one class is a single image or the classes do not overlap at all.
    Disjoint pairs (one of each class) are independent trials then: k of k in order leave
    0.025^(1/k) possible, whatever the distributions.
    """
    ordered = (stego[:, None] > plain[None]) + 0.5 * (stego[:, None] == plain[None])  # [stego, plain]
    of_stego, of_plain = ordered.mean(1), ordered.mean(0)
    auc = float(ordered.mean())
    pairs = min(len(plain), len(stego))
    variance = 0.0
    if pairs > 1:
        variance = float(of_stego.var(ddof=1) / len(stego) + of_plain.var(ddof=1) / len(plain))
    if variance == 0:
        slack = 1 - 0.025 ** (1 / pairs)
        return max(0.0, auc - slack), min(1.0, auc + slack)
    spread = _Z * math.sqrt(variance) / (auc * (1 - auc))
    middle = math.log(auc / (1 - auc))
    return _expit(middle - spread), _expit(middle + spread)


def _expit(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x >= 0 else math.exp(x) / (1 + math.exp(x))


def _numbers(
    negatives: Sequence[Score], positives: Sequence[Score]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both as ranks, which decide all, with what is missing below."""
    scores = np.array(
        [math.nan if score is None else score for score in (*negatives, *positives)], dtype=float
    )
    scores[np.isnan(scores)] = -np.inf
    ranks = np.unique(scores, return_inverse=True)[1].astype(np.float64)
    return ranks[: len(negatives)], ranks[len(negatives) :]


def _is_missing(score: Score) -> bool:
    return score is None or math.isnan(score)


def _unanswered(scores: Sequence[Score]) -> int:
    return sum(map(_is_missing, scores))


def _row(scores: Scores) -> dict[str, Score]:
    return {name: None if _is_missing(score) else score for name, score in asdict(scores).items()}
