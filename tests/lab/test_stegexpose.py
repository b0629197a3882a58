"""StegExpose: equal to the original on its images, and to its description on any."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import chi2

from keyss.core import UsageError
from keyss.lab import Scores, lsb_detectors, score_image
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
                score = getattr(scores, name)
                if row[name] == "null":
                    assert score is None, (row["file"], name)
                else:
                    assert score == pytest.approx(float(row[name]), abs=1e-9, rel=0, nan_ok=True), (
                        row["file"],
                        name,
                    )
            assert str(scores.fusion > 0.2).lower() == row["flagged"], row["file"]


class TestByHand:
    @pytest.mark.parametrize(
        ("pairs", "score"),
        [
            # X, Y that counts as W, Y of two even numbers, Z, Z: 1.5 x² - 3 x + 1 = 0
            ([1, 2, 3, 2, 4, 2, 5, 5, 7, 7], 1 - 1 / math.sqrt(3)),
            # as above, but the second Y counts as W too, though 9 and 2 are no such pair: 2 x² - 3 x + 1 = 0
            ([1, 2, 3, 2, 9, 2, 5, 5, 7, 7], 0.5),
            # and three: no root
            ([1, 2, 3, 2, 9, 2, 7, 2, 5, 5, 7, 7], math.nan),
            # an odd last column is left out
            ([1, 2, 3, 2, 4, 2, 5, 5, 7, 7, 99], 1 - 1 / math.sqrt(3)),
        ],
    )
    def test_primary_sets(self, pairs: list[int], score: float) -> None:
        image = np.zeros((1, len(pairs), 3), dtype=np.uint8)
        image[0, :, 0] = pairs  # red alone counts
        assert score_image(image).primary_sets == pytest.approx(score, nan_ok=True)

    def test_four_pixels(self) -> None:
        """Sample Pairs: 2 x² - 4 x + 2 = 0; Primary Sets: x² - 2 x + 2 = 0; RS: 0 / 0."""
        scores = score_image(grey([[2, 3], [2, 3]]))
        assert scores.sample_pairs == 1.0
        assert scores.chi_square is None
        assert math.isnan(scores.primary_sets or 0)
        assert math.isnan(scores.rs or 0)
        assert scores.fusion == 1.0

    @pytest.mark.parametrize("value", [0, 128, 255])
    def test_one_colour(self, value: int) -> None:
        """All pairs are equal, all blocks get rougher, and a histogram has one bin: all in closed form."""
        height, width = 300, 302
        scores = score_image(np.full((height, width, 3), value, dtype=np.uint8))
        assert (scores.primary_sets, scores.sample_pairs, scores.rs) == (0, 0, 0)
        p_values = []
        for block in range(1, 3 * height * width // 1024):
            filled = 1024 * block
            observed = 1 if value % 2 else 1 + filled
            scale = (127 + observed) / (127 + 1 + filled // 2)
            others, this = scale, scale * (1 + filled // 2)
            p_values.append(chi2.sf(127 * (1 - others) ** 2 / others + (observed - this) ** 2 / this, 127))
        assert scores.chi_square == pytest.approx(np.mean(p_values), abs=1e-9)

    def test_rs_at_its_pole(self) -> None:
        """4 x² - 1 = 0: of the roots -1/2 and 1/2 the positive, at which x / (x - 1/2) is taken for 0."""
        assert lsb_detectors._rate(np.array([[1, 0], [2, 0]]), np.array([[1, 0], [0, 2]])) == 0

    def test_nothing_answers(self) -> None:
        scores = score_image(grey([[7]]))
        assert math.isnan(scores.fusion)
        assert scores.chi_square is scores.sample_pairs is None


class TestAgainstItsDescription:
    """The same, written out one pixel at a time."""

    @given(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 2, 3, 5, 256]), st.integers(0, 2**32))
    @settings(max_examples=300, deadline=None)
    def test_any_small_image(self, height: int, width: int, levels: int, seed: int) -> None:
        random = np.random.default_rng(seed)
        lowest = random.integers(0, 257 - levels)
        self.check(random.integers(lowest, lowest + levels, (height, width, 3)).astype(np.uint8))

    @pytest.mark.parametrize("size", [(131, 24), (258, 11)])  # RS goes by strips of 128 rows
    def test_high_images(self, size: tuple[int, int]) -> None:
        self.check(smooth(size))

    @pytest.mark.parametrize("rate", [0.0, 0.4])
    def test_images_with_room_for_chi_square(self, rate: float) -> None:
        image = with_payload(smooth((297, 296)), rate)
        assert score_image(image).chi_square is not None
        assert score_image(image[:-1]).chi_square is None
        stream = image.reshape(-1).tolist()
        assert score_image(image).chi_square == pytest.approx(literal.chi_square(stream), abs=1e-9)

    def test_many_blocks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Chi Square does not care how many of its histograms are in memory together."""
        whole = score_image(smooth())
        monkeypatch.setattr("keyss.lab.lsb_detectors._AT_ONCE", 100)
        assert score_image(smooth()).chi_square == pytest.approx(whole.chi_square, abs=1e-12)

    @staticmethod
    def check(image: Pixels) -> None:
        scores, expected = score_image(image), literal.fused(image)
        for name in (*DETECTORS, "fusion"):
            score, right = getattr(scores, name), expected[name]
            if right is None:
                assert score is None, name
            else:
                assert score == pytest.approx(right, abs=1e-9, nan_ok=True), name
                assert math.isnan(score) or 0 <= score <= 1, name


RATES = (0.0, 0.1, 0.25, 0.5, 1.0)


@pytest.fixture(scope="module")
def found() -> list[Scores]:
    """Of one image with payloads of these rates."""
    return [score_image(with_payload(smooth(), rate)) for rate in RATES]


class TestPayloads:
    @pytest.mark.parametrize(("detector", "off"), [("rs", 0.06), ("sample_pairs", 0.09)])
    def test_rs_and_sample_pairs_find_the_rate(self, found: list[Scores], detector: str, off: float) -> None:
        assert [getattr(scores, detector) for scores in found] == pytest.approx(list(RATES), abs=off)

    @pytest.mark.parametrize("detector", ["rs", "sample_pairs", "chi_square", "fusion"])
    def test_more_payload_scores_higher(self, found: list[Scores], detector: str) -> None:
        scores = [getattr(each, detector) for each in found]
        assert all(less < more for less, more in pairwise(scores))

    def test_primary_sets_finds_no_solution_for_large_payloads(self, found: list[Scores]) -> None:
        assert [math.isnan(scores.primary_sets or 0) for scores in found] == [False] * 3 + [True] * 2

    def test_the_mean_tells_a_full_image_from_an_empty_one(self, found: list[Scores]) -> None:
        assert found[0].fusion < 0.2 < found[-1].fusion


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
