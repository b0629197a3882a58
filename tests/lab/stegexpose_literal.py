"""The description of StegExpose written out one pixel at a time in plain Python."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.stats import chi2

Pixels = list[list[int]]  # one channel, by rows


def fused(image: npt.NDArray[np.uint8]) -> dict[str, float | None]:
    """What `score_image` should say."""
    channels: list[Pixels] = [image[:, :, channel].tolist() for channel in range(3)]
    scores = {
        "primary_sets": primary_sets(channels[0]),
        "chi_square": chi_square(image.reshape(-1).tolist()),
        "sample_pairs": sample_pairs(channels),
        "rs": rs(channels),
    }
    kept = {name: None if score is None else min(abs(score), 1.0) for name, score in scores.items()}
    kept = {name: math.nan if scores[name] != scores[name] else score for name, score in kept.items()}
    answers = [score for score in kept.values() if score is not None and not math.isnan(score)]
    return {**kept, "fusion": sum(answers) / len(answers) if answers else math.nan}


def primary_sets(red: Pixels) -> float:
    x = y = z = w = p = 0
    for row in red:
        for left in range(0, len(row) - 1, 2):
            u, v = row[left], row[left + 1]
            p += 1
            if u == v:
                z += 1
            elif (v % 2 == 0 and u < v) or (v % 2 == 1 and u > v):
                x += 1
            else:
                y += 1
                if not (u % 2 == 0 and v % 2 == 0):
                    w += 1
    a, b, c = (w + z) / 2, 2 * x - p, y - x
    return divided(-b - root(b * b - 4 * a * c), 2 * a)


def sample_pairs(channels: list[Pixels]) -> float | None:
    height, width = len(channels[0]), len(channels[0][0])
    if height % 2 == 1 or width % 2 == 1:
        return None
    rates = []
    for pixels in channels:
        pairs = [(pixels[i][j], pixels[i][j + 1]) for i in range(height) for j in range(0, width, 2)]
        pairs += [(pixels[i][j], pixels[i + 1][j]) for i in range(0, height, 2) for j in range(width)]
        x = sum((v % 2 == 0 and u < v) or (v % 2 == 1 and u > v) for u, v in pairs)
        y = sum((v % 2 == 0 and u > v) or (v % 2 == 1 and u < v) for u, v in pairs)
        z = sum(u == v for u, v in pairs)
        w = sum(u >> 1 == v >> 1 and u != v for u, v in pairs)
        a, b, c = (w + z) / 2, 2 * x - len(pairs), y - x
        rate = nearer(a, b, c) if b * b - 4 * a * c >= 0 else divided(c, b)
        rates.append(divided(c, b) if rate == 0 else rate)
    return sum(rates) / 3


def chi_square(stream: list[int]) -> float | None:
    blocks = len(stream) // 1024 - 1
    if blocks < 256:
        return None
    histogram, total = [1] * 256, 0.0
    for block in range(blocks):
        for value in stream[1024 * block : 1024 * (block + 1)]:
            histogram[value] += 1
        observed = [histogram[2 * k] for k in range(128)]
        expected: list[float] = [(histogram[2 * k] + histogram[2 * k + 1]) // 2 for k in range(128)]
        if abs(sum(observed) - sum(expected)) > 1e-5:
            scale = sum(observed) / sum(expected)
            expected = [scale * value for value in expected]
        statistic = sum((o - e) ** 2 / e for o, e in zip(observed, expected, strict=True))
        total += float(chi2.sf(statistic, 127))
    return total / blocks


def rs(channels: list[Pixels]) -> float:
    overlapping, disjoint = ([rs_rate(pixels, stride) for pixels in channels] for stride in (1, 2))
    return (sum(overlapping) / 3 + sum(disjoint) / 3) / 2


def rs_rate(pixels: Pixels, stride: int) -> float:
    flipped = [[value ^ 1 for value in row] for row in pixels]
    r0, s0 = groups(pixels, stride, +1)
    r_0, s_0 = groups(pixels, stride, -1)
    r1, s1 = groups(flipped, stride, +1)
    r_1, s_1 = groups(flipped, stride, -1)
    d0, d_0, d1, d_1 = r0 - s0, r_0 - s_0, r1 - s1, r_1 - s_1
    a, b, c = 2 * (d1 + d0), d_0 - d_1 - d1 - 3 * d0, d0 - d_0
    straight = (divided(r_0 - r0, r1 - r0 + r_0 - r_1) + divided(s_0 - s0, s1 - s0 + s_0 - s_1)) / 2
    x = nearer(a, b, c) if b * b - 4 * a * c >= 0 else straight
    if x == 0:
        of_regular = ((r_1 - r1 + r0 - r_0) + divided(r_0 - r0, x)) / (x - 1)
        of_singular = ((s_1 - s1 + s0 - s_0) + divided(s_0 - s0, x)) / (x - 1)
        if of_singular > 0 or of_regular < 0:
            x = straight
    if x == 0.5:
        return 0.0
    return abs(x / (x - 0.5))


def groups(pixels: Pixels, stride: int, sign: int) -> tuple[int, int]:
    """Regular and singular 2x2 blocks, both masks together."""

    def flip(value: int) -> int:
        return value ^ 1 if sign > 0 else ((value + 1) ^ 1) - 1

    def rough(x: list[int]) -> int:
        return abs(x[0] - x[1]) + abs(x[2] - x[3]) + abs(x[0] - x[2]) + abs(x[1] - x[3])

    regular = singular = 0
    for i, j in product(range(0, len(pixels) - 1, stride), range(0, len(pixels[0]) - 1, stride)):
        block = [pixels[i][j], pixels[i][j + 1], pixels[i + 1][j], pixels[i + 1][j + 1]]
        for mask in ((0, 3), (1, 2)):
            after = rough([flip(value) if place in mask else value for place, value in enumerate(block)])
            regular += after > rough(block)
            singular += after < rough(block)
    return regular, singular


def nearer(a: float, b: float, c: float) -> float:
    """The root of smaller magnitude, at a tie the one with the plus sign."""
    discriminant = b * b - 4 * a * c
    plus, minus = divided(-b + root(discriminant), 2 * a), divided(-b - root(discriminant), 2 * a)
    return plus if abs(plus) <= abs(minus) else minus


def root(x: float) -> float:
    return math.sqrt(x) if x >= 0 else math.nan


def divided(a: float, b: float) -> float:
    """As Java divides: by zero too, whose sign counts."""
    with np.errstate(all="ignore"):
        return float(np.float64(a) / np.float64(b))


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
