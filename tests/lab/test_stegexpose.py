"""StegExpose: equal to the original on its images, and right about known payloads."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from keyss.core import UsageError
from keyss.lab import score_image, stegexpose_auc

DETECTORS = ("primary_sets", "chi_square", "sample_pairs", "rs")
Pixels = npt.NDArray[np.uint8]


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
    """Random last bits in a share of the samples."""
    random = np.random.default_rng(1)
    bits = random.integers(0, 2, image.shape, dtype=np.uint8)
    return np.where(random.random(image.shape) < rate, image & 254 | bits, image)


def test_scores_of_the_original_program(real_data: Path) -> None:
    folder = real_data / "stegexpose"
    with (folder / "reference_scores.csv").open() as file:
        expected = list(csv.DictReader(file))
    assert len(expected) == 34
    for row in expected:
        scores = score_image(read_pixels(folder / row["file"]))
        for name in (*DETECTORS, "fusion"):
            right = float("nan" if row[name] == "null" else row[name])
            expected_score = pytest.approx(right, abs=1e-9, rel=0, nan_ok=True)
            assert scores[name] == expected_score, (row["file"], name)
        assert str(scores["fusion"] > 0.2).lower() == row["flagged"], row["file"]


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.2])
def test_estimated_embedding_rates(rate: float) -> None:
    scores = score_image(with_payload(smooth(), rate))
    for name in ("primary_sets", "sample_pairs", "rs"):
        assert scores[name] == pytest.approx(rate, abs=0.1), name


def test_unsuitable_images() -> None:
    image = smooth((296, 297))
    assert not math.isnan(score_image(image)["chi_square"])
    assert math.isnan(score_image(image[:-1, :-2])["chi_square"])
    assert math.isnan(score_image(image)["sample_pairs"])
    tiny = score_image(image[:1, :1])
    assert math.isnan(tiny["chi_square"])
    assert math.isnan(tiny["rs"])


def test_replaced_last_bits_are_detected() -> None:
    whole = smooth((380, 300))
    plain = [whole[10 * index : 10 * index + 300] for index in range(8)]
    assert stegexpose_auc(plain, [with_payload(image, 0.7) for image in plain]).auc == 1


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), dtype=np.uint8),
        np.zeros((4, 4, 4), dtype=np.uint8),
        np.zeros((4, 4, 3)),
        np.zeros((0, 4, 3), dtype=np.uint8),
    ],
)
def test_invalid_arrays(image: npt.NDArray[np.uint8]) -> None:
    with pytest.raises(UsageError, match="uint8"):
        score_image(image)


def read_pixels(path: Path) -> npt.NDArray[np.uint8]:
    """[H, W, 3] of an image file as Java's ImageIO decodes it.

    Transparency is ignored, not blended. Grey of 8 and 16 bits counts as linear light and gets the sRGB
    curve, which turns 256 levels into 183. Colours of 16 bits keep their upper byte, which may be off by 1.
    """
    image = Image.open(path)
    if image.mode.startswith("I"):
        light = np.asarray(image, dtype=np.float64).clip(0, 65535) / 65535
    elif image.mode in ("L", "LA") and image.format != "BMP":  # a grey BMP has a palette
        light = np.asarray(image.getchannel(0)) / 255
    else:
        image.load()
        image.info.pop("transparency", None)  # avoids a warning by Pillow
        return np.array(image.convert("RGB"), dtype=np.uint8)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    return np.repeat(np.rint(255 * encoded).astype(np.uint8)[:, :, None], 3, axis=2)
