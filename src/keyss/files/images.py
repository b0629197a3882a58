"""Reads photos as RGB and encodes PNG files."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from keyss.core.arrays import Bytes, Floats, Numbers
from keyss.core.errors import InputError
from keyss.core.scene import Camera

# Photo formats only: Pillow opens some others with external programs.
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
_MAX_PIXELS = 89_000_000  # just under Pillow's own limit for decompression bombs
_SMALL_PIXELS, _PIXELS_PER_BYTE = 24_000_000, 16  # larger images need file bytes in proportion
_BAND = 1 << 18  # pixels converted at a time


def open_image(path: Path) -> Image.Image:
    """Open an image without decoding its pixels.

    Raises InputError if the file is missing, is not an image, or has more than 89 million pixels or more than
    its bytes can hold.
    """
    try:
        image = Image.open(path, formats=_FORMATS)
    except FileNotFoundError as error:
        raise InputError(f"{path}: expected an image, but there is no such file") from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(f"{path}: expected an image of at most {_MAX_PIXELS:,} pixels: {error}") from error
    except Exception as error:  # Pillow's parsers raise nearly anything on broken headers
        kinds = ", ".join(_FORMATS)
        if os.path.isfile(path) and os.path.getsize(path) == 0:
            raise InputError(f"{path}: expected an image ({kinds}), found an empty file") from error
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, UnidentifiedImageError):  # such as HEIC
            reason = "it is damaged, or has another format and must be converted"
        raise InputError(f"{path}: expected an image ({kinds}), but it cannot be read: {reason}") from error
    limit = min(_MAX_PIXELS, max(_SMALL_PIXELS, _PIXELS_PER_BYTE * os.path.getsize(path)))
    if image.width * image.height > limit:
        image.close()
        raise InputError(
            f"{path}: expected an image of at most {limit:,} pixels, found {image.width}x{image.height}"
        )
    return image


def probe_image(path: Path) -> tuple[int, int, bool]:
    """(width, height, whether it has transparency) from the header of an image.

    Ignores the EXIF orientation, like COLMAP. Raises InputError as `open_image` does.
    """
    with open_image(path) as image:
        return image.width, image.height, image.has_transparency_data


def is_rotated_by_exif(path: Path) -> bool:
    """True if the EXIF orientation rotates an image by 90 degrees. Raises InputError."""
    with open_image(path) as image:
        return image.getexif().get(0x0112, 1) in (5, 6, 7, 8)


def read_image(path: Path, background: Floats) -> Bytes:
    """[H, W, 3] sRGB of an image file, composited over `background` ([3] in [0, 1]).

    16 bits are scaled to 8; palettes, grey and CMYK are converted. Raises InputError as `open_image` does,
    for more than 16 bits, whose range is unknown, and if the pixels cannot be decoded.
    """
    with open_image(path) as image:
        try:
            if image.mode == "F" or (image.mode == "I" and np.max(image.getextrema()) > 65535):
                raise ValueError("its pixels have 32 bits; convert it to 8 or 16")
            return _to_rgb(image, background)
        except Exception as error:  # Pillow's decoders raise nearly anything on broken bytes
            raise InputError(f"{path}: expected an image, but it cannot be decoded: {error}") from error


def read_mask(path: Path, width: int, height: int) -> Bytes:
    """[height, width] an image file resized by nearest neighbour: 0 where it is black, else 255.

    Raises InputError as `open_image` does, and if the aspect differs by more than a pixel.
    """
    import cv2

    with open_image(path) as image:
        if abs(image.height * width / image.width - height) > 1:
            raise InputError(
                f"{path}: expected a mask of its photo's aspect, {width}x{height}, found "
                f"{image.width}x{image.height}"
            )
        try:
            used = np.asarray(image if image.mode.startswith("I") else image.convert("L")) > 0
        except Exception as error:  # as in read_image
            raise InputError(f"{path}: expected a mask, but it cannot be decoded: {error}") from error
    return np.asarray(cv2.resize(np.uint8(255) * used, (width, height), interpolation=cv2.INTER_NEAREST))


def downscale(image: Bytes, width: int, height: int) -> Bytes:
    """Downscale an image [H, W, ...] by area averaging."""
    import cv2  # slow to import, and models do not need it

    # Pillow's BOX filter rounds after each axis, which brightens by up to one level.
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def png_names(cameras: Iterable[Camera]) -> list[str]:
    """A PNG file name for each camera: folders joined by underscores, duplicates numbered (`a-2.png`)."""
    names: dict[str, None] = {}  # an ordered set
    numbers: dict[str, int] = {}  # the last number of a stem
    for camera in cameras:
        stem = Path(camera.name.replace("/", "_").replace("\\", "_")).stem
        name = f"{stem}.png"
        while name in names:
            numbers[stem] = numbers.get(stem, 1) + 1
            name = f"{stem}-{numbers[stem]}.png"
        names[name] = None
    return list(names)


def animation_bytes(images: Sequence[Tensor]) -> bytes:
    """An endless animation of uint8 images [H, W, 3] in 6 seconds, as WebP."""
    first, *others = (Image.fromarray(image.numpy()) for image in images)
    file, duration = io.BytesIO(), round(6000 / len(images))
    first.save(file, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=80)
    return file.getvalue()


def png_bytes(image: Tensor) -> bytes:
    """An image [H, W, 3] uint8 as a PNG file."""
    import cv2

    return bytes(cv2.imencode(".png", image.numpy()[:, :, ::-1])[1].tobytes())


def _to_rgb(image: Image.Image, background: Floats) -> Bytes:
    rgb = np.empty((image.height, image.width, 3), np.uint8)
    rows = max(1, _BAND // image.width)
    for top in range(0, image.height, rows):
        end = min(top + rows, image.height)
        rgb[top:end] = _rows_to_rgb(image.crop((0, top, image.width, end)), background)
    return rgb


def _rows_to_rgb(image: Image.Image, background: Floats) -> Numbers:
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip instead of scale
        grey = np.asarray(image, dtype=np.float64).clip(0, 65535)
        return np.rint(grey / 257)[:, :, None]
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32)
        alpha = rgba[:, :, 3:] / 255
        return np.rint(rgba[:, :, :3] * alpha + 255 * background * (1 - alpha))
    return np.asarray(image.convert("RGB"))
