"""Writes videos as MP4 with PyAV (extra `video`)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError, import_extra
from keyss.files.atomic import write_bytes

SUFFIX = ".mp4"
_CODECS = (("libx264", {"crf": "18", "preset": "medium"}), ("mpeg4", {"qscale": "3"}))


def check_video(path: Path | str) -> None:
    """Raise UsageError if a path does not end in .mp4, BackendError if PyAV is not installed."""
    if Path(path).suffix.lower() != SUFFIX:
        raise UsageError(f"cannot write a video as {path}: expected a name that ends in {SUFFIX}")
    import_extra("av", "video", "write videos")


def write_video(path: Path | str, frames: Iterator[Bytes], fps: int) -> int:
    """Atomically write frames [H, W, 3] of one even size at `fps` per second; returns their number.

    Encodes H.264 if this build of FFmpeg has it, else MPEG-4, in sRGB with 4:2:0 subsampling.
    """
    av = import_extra("av", "video", "write videos")
    data, count = io.BytesIO(), 0
    with av.open(data, "w", format="mp4") as container:
        stream = None
        for pixels in frames:
            if stream is None:
                stream = _stream(av, container, fps, *pixels.shape[1::-1])
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
            count += 1
        for packet in stream.encode() if stream else ():
            container.mux(packet)
    write_bytes(Path(path), data.getvalue())
    return count


def _stream(av: Any, container: Any, fps: int, width: int, height: int) -> Any:
    codec, options = next((each for each in _CODECS if each[0] in av.codecs_available), _CODECS[-1])
    stream = container.add_stream(codec, rate=Fraction(fps), options=options)
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    return stream
