"""Conversions to other formats and back by third-party programs: gsply (PyPI) and splat-transform (npm).

pip install gsply
npm install --no-save @playcanvas/splat-transform@2.7.1
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

from keyss.core.errors import BackendError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.files.models import read_model, write_model
from keyss.measure.robustness.changes import Change

TIMEOUT = 600.0  # seconds for one conversion


@dataclass(frozen=True)
class Converter:
    """Converts models to a format and back."""

    format: str
    tool: str
    note: str  # a remark on this conversion, or nothing
    there_and_back: Callable[[Path, Path], tuple[Path, Path]]  # .ply, folder -> other file, .ply

    def __call__(self, model: Gaussians) -> Gaussians:
        """Raises BackendError if the tool is missing or fails."""
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "source.ply"
            write_model(source, model)
            try:
                return read_model(self.there_and_back(source, Path(folder))[1])
            except BackendError:
                raise
            except (KeyssError, OSError, ValueError) as error:
                reason = (str(error) or type(error).__name__).splitlines()[0]
                raise BackendError(f"{self.tool} failed on {self.format}: {reason}") from error

    def change(self) -> Change:
        sentence = f"Converted to {self.format} and back by {self.tool}{self.note}."
        attack = f"conversion to {self.format} by {self.tool}"
        return Change(attack, 1, "times", sentence, lambda model: self(model).to(model.device))


def converters(sog_iterations: int = 1) -> list[Converter]:
    """All known conversions, whether or not their tools are installed.

    `sog_iterations`: of the clustering of harmonics in .sog, by default ten in splat-transform, which without
    a GPU takes half a minute each for 20,000 Gaussians.
    """
    rounds = "one round" if sog_iterations == 1 else f"{sog_iterations} rounds"
    return [
        Converter("compressed .ply", "gsply", "", _gsply_compressed),
        Converter(".spz", "gsply", " (version 3)", _gsply_spz),
        Converter("compressed .ply", "splat-transform", "", _through("there.compressed.ply")),
        Converter(".spz", "splat-transform", " (version 4)", _through("there.spz")),
        Converter(
            ".sog",
            "splat-transform",
            f", with {rounds} of clustering harmonics",
            _through("there.sog", "-i", str(sog_iterations)),
        ),
        Converter(".splat", "splat-transform", ", which only reads this format", _splat),
    ]


def find_splat_transform() -> str:
    """The program: KEYSS_SPLAT_TRANSFORM, else node_modules here, else on the PATH. Raises BackendError."""
    here = Path("node_modules") / ".bin" / "splat-transform"
    named = os.environ.get("KEYSS_SPLAT_TRANSFORM")
    program = named or (str(here.absolute()) if here.exists() else shutil.which("splat-transform"))
    if not program or not Path(program).exists():
        raise BackendError(
            "splat-transform is not installed (npm install --no-save @playcanvas/splat-transform@2.7.1, "
            "or its path in KEYSS_SPLAT_TRANSFORM)"
        )
    return program


def find_package(name: str) -> ModuleType:
    """A third-party Python package. Raises BackendError."""
    try:
        return import_module(name)
    except ImportError as error:
        raise BackendError(f"{name} is not installed (pip install {name})") from error


def transform(source: Path, target: Path, *options: str) -> Path:
    """`target`, converted from `source` by splat-transform. Raises BackendError."""
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
    def there_and_back(source: Path, folder: Path) -> tuple[Path, Path]:
        there = transform(source, folder / name, *options)
        return there, transform(there, folder / "back.ply")

    return there_and_back


def _gsply_compressed(source: Path, folder: Path) -> tuple[Path, Path]:
    gsply, there, back = find_package("gsply"), folder / "there.compressed.ply", folder / "back.ply"
    gsply.plywrite(there, gsply.plyread(source), compressed=True)
    gsply.plywrite(back, gsply.plyread(there))
    return there, back


def _gsply_spz(source: Path, folder: Path) -> tuple[Path, Path]:
    gsply, there, back = find_package("gsply"), folder / "there.spz", folder / "back.ply"
    gsply.write_spz(there, gsply.plyread(source), version=3)
    gsply.plywrite(back, gsply.read_spz(there))
    return there, back


def _splat(source: Path, folder: Path) -> tuple[Path, Path]:
    there = folder / "there.splat"
    write_model(there, read_model(source))
    return there, transform(there, folder / "back.ply")
