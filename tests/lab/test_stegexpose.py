"""StegExpose: equal to the original on its images, and to its description on any."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings, strategies as st

from keyss.core import UsageError
from keyss.lab import score_image
from lab import stegexpose_literal as literal

DETECTORS = ("primary_sets", "chi_square", "sample_pairs", "rs")
Pixels = npt.NDArray[np.uint8]


def grey(rows: list[list[int]]) -> Pixels:
    """[H, W, 3] with three equal channels."""
    return np.repeat(np.array(rows, dtype=np.uint8)[:, :, None], 3, axis=2)


def smooth(size: tuple[int, int] = (300, 302)) -> Pixels:
    """A shaded surface with the noise of a sensor: [H, W, 3].

    Its contrast is changed, which leaves gaps in the histogram: Chi Square takes smooth ones for a payload.
    """
    random = np.random.default_rng(0)
    y, x = np.mgrid[: size[0], : size[1]] / 50
    light = np.stack([100 + 60 * np.sin(x + k) * np.cos(y - k) + 8 * y for k in range(3)], axis=2)
    levels = np.rint(light + random.normal(0, 1.2, light.shape)).clip(0, 255).astype(np.uint8)
    contrast = np.rint(255 * (np.arange(256) / 255) ** 0.9).astype(np.uint8)
    shaded: Pixels = contrast[levels]
    return shaded


def with_payload(image: Pixels, rate: float) -> Pixels:
    """Random bits in place of the last ones of so many of the samples."""
    random = np.random.default_rng(1)
    bits = random.integers(0, 2, image.shape, dtype=np.uint8)
    return np.where(random.random(image.shape) < rate, image & 254 | bits, image)


class TestAgainstTheOriginal:
    def test_every_score_is_the_same(self, real_data: Path) -> None:
        folder = real_data / "stegexpose"
        with (folder / "reference_scores.csv").open() as file:
            expected = list(csv.DictReader(file))
        assert len(expected) == 34
        for row in expected:
            scores = score_image(literal.read_pixels(folder / row["file"]))
            for name in (*DETECTORS, "fusion"):
                score = scores[name]
                if row[name] == "null":
                    assert score is None, (row["file"], name)
                else:
                    assert score == pytest.approx(float(row[name]), abs=1e-9, rel=0, nan_ok=True), (
                        row["file"],
                        name,
                    )
            assert str((scores["fusion"] or 0) > 0.2).lower() == row["flagged"], row["file"]


class TestAgainstItsDescription:
    """The same, written out one pixel at a time."""

    @given(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 2, 3, 5, 256]), st.integers(0, 2**32))
    @settings(max_examples=100, deadline=None)
    def test_any_small_image(self, height: int, width: int, levels: int, seed: int) -> None:
        random = np.random.default_rng(seed)
        lowest = random.integers(0, 257 - levels)
        self.check(random.integers(lowest, lowest + levels, (height, width, 3)).astype(np.uint8))

    @pytest.mark.parametrize("rate", [0.0, 0.4])
    def test_images_with_room_for_chi_square(self, rate: float) -> None:
        image = with_payload(smooth((297, 296)), rate)
        assert score_image(image)["chi_square"] is not None
        assert score_image(image[:-1])["chi_square"] is None
        stream = image.reshape(-1).tolist()
        assert score_image(image)["chi_square"] == pytest.approx(literal.chi_square(stream), abs=1e-9)

    @staticmethod
    def check(image: Pixels) -> None:
        scores, expected = score_image(image), literal.fused(image)
        for name in (*DETECTORS, "fusion"):
            score, right = scores[name], expected[name]
            if right is None:
                assert score is None, name
            else:
                assert score == pytest.approx(right, abs=1e-9, nan_ok=True), name
                assert math.isnan(score) or 0 <= score <= 1, name


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), dtype=np.uint8),
        np.zeros((4, 4, 4), dtype=np.uint8),
        np.zeros((4, 4, 3)),
        np.zeros((0, 4, 3), dtype=np.uint8),
    ],
)
def test_other_arrays_are_refused(image: npt.NDArray[np.uint8]) -> None:
    with pytest.raises(UsageError, match="uint8"):
        score_image(image)
