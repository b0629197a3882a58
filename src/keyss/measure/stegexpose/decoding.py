"""The pixels that a Java program gets of an image file, which are not always those that others get."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from keyss.core.errors import InputError
from keyss.files.images import open_image


def read_pixels(path: Path | str) -> NDArray[np.uint8]:
    """[H, W, 3] of an image file as Java's ImageIO decodes it.

    Transparency is ignored, not blended. Grey of 8 and 16 bits is taken for linear light and gets the sRGB
    curve, so that 256 levels become 183. Colours of 16 bits keep their upper byte, which may be 1 off.
    Raises InputError for what cannot be read or has more than 89 million pixels.
    """
    path = Path(path)
    with open_image(path) as image:
        try:
            return _decode(image)
        except Exception as error:  # Pillow's decoders raise nearly anything on broken bytes
            raise InputError(
                f"{path}: expected an image, but its pixels cannot be decoded: {error}"
            ) from error


def _decode(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):
        return _three(_as_linear(np.asarray(image, dtype=np.float64).clip(0, 65535) / 65535))
    if image.mode in ("L", "LA") and image.format != "BMP":  # a grey BMP has a palette, in truth
        return _three(_as_linear(np.asarray(image.getchannel(0)) / 255))
    image.load()
    image.info.pop("transparency", None)  # Pillow would warn that it gets lost
    return np.array(image.convert("RGB"), dtype=np.uint8)


def _as_linear(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[H, W] sRGB bytes of linear light in [0, 1]: IEC 61966-2-1."""
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    rounded: NDArray[np.uint8] = np.rint(255 * encoded).astype(np.uint8)
    return rounded


def _three(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(grey[:, :, None], 3, axis=2)
