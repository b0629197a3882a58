"""The four detectors on one image, and their mean."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from keyss.core.errors import UsageError
from keyss.measure.stegexpose.chi_square import chi_square
from keyss.measure.stegexpose.decoding import read_pixels
from keyss.measure.stegexpose.pixel_pairs import primary_sets, sample_pairs
from keyss.measure.stegexpose.rs import rs

# In the order in which the original program runs them, which matters to whoever stops early.
_ORDER = {"primary_sets": primary_sets, "sample_pairs": sample_pairs, "chi_square": chi_square, "rs": rs}
DETECTORS = ("primary_sets", "chi_square", "sample_pairs", "rs")  # in the order of its table


@dataclass(frozen=True)
class Scores:
    """What StegExpose says of one image, each in [0, 1].

    A detector is NaN where its equation has no solution and None where it does not take the image (Sample
    Pairs: an odd width or height; Chi Square: less than about 87,700 pixels) or was not reached. `fusion` is
    the mean of the others, NaN where there are none. It averages whatever answered: compare only images of
    one size.
    """

    primary_sets: float | None
    chi_square: float | None
    sample_pairs: float | None
    rs: float | None
    fusion: float | None  # None in records of what is NaN


def score_image(image: NDArray[np.uint8], *, stop_below: float | None = None) -> Scores:
    """Scores of an image [H, W, 3] uint8.

    `stop_below` is the original's fast mode: as soon as the mean of what has answered is below it, the
    detectors that are left are not run. Such means are of different detectors: make no ROC of them.
    Raises UsageError for another shape or type.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UsageError(f"expected an image [H, W, 3] of uint8, got {list(image.shape)} of {image.dtype}")
    found: dict[str, float | None] = dict.fromkeys(DETECTORS)
    answers: list[float] = []
    for name, detector in _ORDER.items():
        score = detector(image)
        if score is not None:
            found[name] = score = score if math.isnan(score) else min(abs(score), 1.0)
            if not math.isnan(score):
                answers.append(score)
        if stop_below is not None and answers and sum(answers) / len(answers) < stop_below:
            break
    return Scores(**found, fusion=sum(answers) / len(answers) if answers else math.nan)


def score_file(path: Path | str, *, stop_below: float | None = None) -> Scores:
    """`score_image` of a file, decoded as the original does (`read_pixels`). Raises InputError."""
    return score_image(read_pixels(path), stop_below=stop_below)
