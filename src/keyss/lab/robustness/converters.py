"""Conversions to other formats and back by third-party programs.

pip install gsply
npm install --no-save @playcanvas/splat-transform@2.7.1
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from keyss.core.errors import BackendError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.files.file_kinds import find_splat_transform
from keyss.files.models import read_model, write_model
from keyss.lab.robustness.changes import Change

TIMEOUT = 600.0  # seconds for one conversion


@dataclass(frozen=True)
class Converter:
    """Converts models to a format and back."""

    format: str
    tool: str
    note: str  # a remark on this conversion, or nothing
    # .ply, folder -> other file, .ply; raises ImportError or BackendError without the tool
    round_trip: Callable[[Path, Path], tuple[Path, Path]]

    def __call__(self, model: Gaussians) -> Gaussians:
        """Raises BackendError if the tool is missing or fails."""
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "source.ply"
            write_model(source, model)
            try:
                return read_model(self.round_trip(source, Path(folder))[1])
            except BackendError:
                raise
            except ImportError as error:
                raise BackendError(f"{self.tool} is not installed (pip install {self.tool})") from error
            except (KeyssError, OSError, ValueError) as error:
                reason = (str(error) or type(error).__name__).splitlines()[0]
                raise BackendError(f"{self.tool} failed on {self.format}: {reason}") from error

    def change(self) -> Change:
        sentence = f"Converted to {self.format} and back by {self.tool}{self.note}."
        attack = f"conversion to {self.format} by {self.tool}"
        return Change(attack, 1, sentence, lambda model: self(model).to(model.device))


def converters() -> list[Converter]:
    """All known conversions, whether or not their tools are installed.

    Harmonics in .sog are clustered in one round, of half a minute for 20,000 Gaussians; ten are usual.
    """
    return [
        Converter("compressed .ply", "gsply", "", _gsply_compressed),
        Converter(".spz", "gsply", " (version 3)", _gsply_spz),
        Converter("compressed .ply", "splat-transform", "", _through("there.compressed.ply")),
        Converter(".spz", "splat-transform", " (version 4)", _through("there.spz")),
        Converter(
            ".sog",
            "splat-transform",
            ", with one round of clustering harmonics",
            _through("there.sog", "-i", "1"),
        ),
        Converter(".splat", "splat-transform", ", which only reads this format", _splat),
    ]


def transform(source: Path, target: Path, *options: str) -> Path:
    """Convert `source` to `target` with splat-transform; returns `target`. Raises BackendError."""
    tool = find_splat_transform()
    command = [tool, "-q", "-w", "-g", "cpu", *options, str(source), str(target)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired as error:
        raise BackendError(f"splat-transform took more than {TIMEOUT:.0f} s for {target.name}") from error
    except (OSError, subprocess.CalledProcessError) as error:
        message = getattr(error, "stderr", None) or str(error)
        raise BackendError(
            f"splat-transform failed on {target.name}: {message.strip().splitlines()[-1]}"
        ) from error
    return target


def _through(name: str, *options: str) -> Callable[[Path, Path], tuple[Path, Path]]:
    def round_trip(source: Path, folder: Path) -> tuple[Path, Path]:
        there = transform(source, folder / name, *options)
        return there, transform(there, folder / "back.ply")

    return round_trip


def _gsply_compressed(source: Path, folder: Path) -> tuple[Path, Path]:
    gsply, there, back = import_module("gsply"), folder / "there.compressed.ply", folder / "back.ply"
    gsply.plywrite(there, gsply.plyread(source), compressed=True)
    gsply.plywrite(back, gsply.plyread(there))
    return there, back


def _gsply_spz(source: Path, folder: Path) -> tuple[Path, Path]:
    gsply, there, back = import_module("gsply"), folder / "there.spz", folder / "back.ply"
    gsply.write_spz(there, gsply.plyread(source), version=3)
    gsply.plywrite(back, gsply.read_spz(there))
    return there, back


def _splat(source: Path, folder: Path) -> tuple[Path, Path]:
    there = folder / "there.splat"
    write_model(there, read_model(source))
    return there, transform(there, folder / "back.ply")
