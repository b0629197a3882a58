"""Damaged files: each must be read or raise an InputError, quickly and in little memory.

    python tests/files/formats/mutations.py --count 100000
    python tests/files/formats/mutations.py --count 10000 --false-sizes      # only these
    python tests/files/formats/mutations.py --count 10000 --only a.payload   # written by an attacker

Damages files of every format at random, before and after compression: bits, bytes, extreme words, cuts,
repeats, megabytes of zeros; every other file declares false sizes (`false_sizes.py`). Prints failures with a
seed to repeat them.
"""

from __future__ import annotations

import argparse
import ctypes
import gzip
import io
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

from files.formats.false_sizes import FALSE_SIZES, image
from files.scene_files import camera_bytes, counted, image_bytes, point_bytes
from keyss.core import DecodedGaussians, Gaussians, InputError, PictureNetwork
from keyss.files import FORMATS, load_scene, model_bytes, model_of_bytes
from keyss.files.formats.spz import SpzCodes
from keyss.files.images import read_image
from keyss.methods.codec.model_bytes import decode, encode
from keyss.methods.tensors import Header, pack_tensors, refuse_damage, unpack_tensors
from tiny_scenes import random_gaussians

SECONDS = 2.0  # time limit for a file of a few kilobytes
CARRIERS = 6000  # Gaussians of the published model that holds a payload
MEMORY, PER_BYTE = 200 << 20, 32  # memory limit for reading a file: bytes, and bytes per byte of the file
MODELS = tuple(f"a{suffix}" for model_format in FORMATS for suffix in model_format.suffixes)
NAMES = (
    *MODELS,
    *("a.payload", "a.3dgs.safetensors", "a.tensors", "a.png"),
    *("cameras.bin", "images.bin", "points3D.bin"),
)
_EXTREMES = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7F800000, 0x7FC00000, 0x3F800000, 0x10000, 0xFF)


@cache
def examples() -> dict[str, list[bytes]]:
    """Small files of each format, by a name of NAMES."""
    count = 60

    def model(degree: int) -> Gaussians:
        return random_gaussians(count, degree, degree)

    found = {name: [model_bytes(name, model(degree)) for degree in (0, 2)] for name in MODELS}
    found["a.spz"].append(replace(SpzCodes.quantise(model(1)), version=4).serialise())
    found["a.payload"] = [encode(model(degree)) for degree in range(4)]
    layers = ((torch.ones(3, 4, 3, 3), torch.zeros(3)),)
    decoded = DecodedGaussians.of(model(0), PictureNetwork(layers, torch.zeros(4)), torch.zeros(count, 4))
    found["a.3dgs.safetensors"] = [model_bytes("a.3dgs.safetensors", decoded)]
    found["a.tensors"] = [pack_tensors({"a": torch.ones(3), "b": torch.ones(2, 2)}, Header("test", 1))]
    found["a.png"] = [image("PNG", 16, 16)]
    return found | {name: [data] for name, data in _colmap().items()}


def _colmap() -> dict[str, bytes]:
    """The files of a scene of four photos."""
    return {
        "cameras.bin": counted(camera_bytes(params=(16, 16, 8, 8), width=16, height=16)),
        "images.bin": counted(*(image_bytes(i, f"{i}.png", observations=0) for i in range(4))),
        "points3D.bin": counted(*(point_bytes(i, (1, 2, i)) for i in range(9))),
    }


def damaged(name: str, data: bytes, rng: np.random.Generator, false_sizes: float = 0.5) -> bytes:
    """Damage `data` before or after compression, or, with probability `false_sizes`, declare false sizes."""
    if name in FALSE_SIZES and rng.random() < false_sizes:
        return FALSE_SIZES[name](data, rng)
    if rng.random() < 0.7:
        if data.startswith(b"\x1f\x8b"):
            return gzip.compress(_damage_bytes(gzip.decompress(data), rng), 1)
        if data.startswith(b"PK"):
            return _damage_archive(data, rng)
    return _damage_bytes(data, rng)


def _damage_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """A ZIP archive one of whose files is damaged."""
    found = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(found, "w") as new:
        names = old.namelist()
        chosen = "meta.json" if rng.random() < 0.5 else names[rng.integers(len(names))]
        for name in names:
            content = old.read(name)
            new.writestr(name, _damage_bytes(content, rng) if name == chosen else content)
    return found.getvalue()


def _damage_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    found = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        # Damage headers more often: they are short, and most failures come from them.
        end = len(found) if rng.random() < 0.4 else min(len(found), 128)
        at = int(rng.integers(0, max(1, end)))
        match int(rng.integers(0, 7)):
            case 0:
                found[at : at + 1] = bytes([rng.integers(0, 256)])
            case 1:
                found[at : at + 1] = bytes([(found[at] if at < len(found) else 0) ^ 1 << rng.integers(0, 8)])
            case 2:
                found[at : at + 4] = int(rng.choice(_EXTREMES)).to_bytes(4, "little")
            case 3:
                del found[at:]
            case 4:
                found[at:at] = found[at : at + int(rng.integers(1, 64))]
            case 5:
                digits = b"0", b"1", b"9", b"-1", b"1e999", b"99999999999999999999", b"null", b"{}", b"[]"
                found[at : at + 1] = digits[rng.integers(len(digits))]
            case 6:
                found += bytes(int(rng.integers(0, 4)) << 20)
    return bytes(found)


def attempt(name: str, data: bytes) -> str | None:
    """Read a file; returns a description of the failure, if any."""
    start, problem = time.process_time(), None

    def read() -> None:
        nonlocal problem
        try:
            problem = _read(name, data)
        except InputError as error:
            problem = None if len(str(error)) < 1000 else "a message without end"
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"

    used, allowed = peak_memory(read), MEMORY + PER_BYTE * len(data)
    seconds = time.process_time() - start
    if used > allowed:
        return f"{used >> 20:,} MiB of memory for {len(data):,} bytes"
    return problem or (f"{seconds:.1f} s" if seconds > SECONDS + len(data) / 1e6 else None)


def peak_memory(call: Callable[[], None]) -> int:
    """Peak growth of the process in a call, in bytes; 0 on systems other than Linux."""
    if not sys.platform.startswith("linux"):
        call()
        return 0
    ctypes.CDLL(None).malloc_trim(0)  # otherwise freed memory would be reused
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = _memory("VmRSS")
    call()
    return _memory("VmHWM") - before


def _memory(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) << 10


def _read(name: str, data: bytes) -> str | None:
    if name in ("a.png", "cameras.bin", "images.bin", "points3D.bin"):
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _read_from(Path(folder), name, data)
    if name == "a.tensors":
        with refuse_damage("damaged"):
            unpack_tensors(data, Header, "test", 1)
        return None
    model = decode(data, CARRIERS) if name == "a.payload" else model_of_bytes(name, data)
    finite = all(bool(value.isfinite().all()) for value in vars(model).values() if torch.is_tensor(value))
    return None if finite and len(model) else "a model that is empty or not finite"


def _read_from(folder: Path, name: str, data: bytes) -> str | None:
    if name == "a.png":
        (folder / name).write_bytes(data)
        read_image(folder / name, np.ones(3, np.float32))
        return None
    (folder / "images").mkdir()
    for number in range(4):
        (folder / "images" / f"{number}.png").write_bytes(image("PNG", 16, 16))
    for each, content in (_colmap() | {name: data}).items():
        (folder / each).write_bytes(content)
    load_scene(folder)
    return None


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="name of one kind of file")
    parser.add_argument("--false-sizes", action="store_true", help="only files with false sizes")
    asked = parser.parse_args()
    files = [(name, data) for name, every in examples().items() for data in every]
    if asked.only or asked.false_sizes:
        files = [file for file in files if file[0] in ([asked.only] if asked.only else FALSE_SIZES)]
    for name, data in files:
        assert attempt(name, data) is None, (name, attempt(name, data))
    failures, start = 0, time.perf_counter()
    for number in range(asked.count):
        name, data = files[number % len(files)]
        rng = np.random.default_rng([asked.seed, number])
        mutated = damaged(name, data, rng, 1.0 if asked.false_sizes else 0.5)
        if problem := attempt(name, mutated):
            failures += 1
            print(f"{name}, seed {asked.seed}, number {number}: {problem}", flush=True)
        if number % 10_000 == 9_999:
            print(f"{number + 1:,} files, {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    print(f"{asked.count:,} files of {len(files)}: {failures} not as they should be")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
