"""Hostile files give a model or an InputError, in time and memory bounded by the file size."""

from __future__ import annotations

import gzip
import io
import json
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from files.formats.examples import model_of
from files.formats.mutations import MODELS, NAMES, attempt, damaged, examples
from keyss.core import InputError, KeyssWarning
from keyss.files import model_bytes, model_of_bytes, read_model, write_model

MODEL = model_of(60, 1)
MEGABYTE = 1 << 20


def refused(name: str, data: bytes, words: str, *, limit: int = 8 * MEGABYTE) -> None:
    """Assert that `data` raise an InputError with `words`, quickly and in less than `limit` bytes."""
    tracemalloc.start()
    start = time.process_time()  # others may keep the machine busy
    with pytest.raises(InputError, match=words):
        model_of_bytes(name, data)
    assert time.process_time() - start < 5
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < limit, f"{peak:,} bytes"


@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")  # of Gaussians that are left out
@pytest.mark.parametrize("name", NAMES)
def test_damaged_files(name: str) -> None:
    for data in examples()[name]:
        assert attempt(name, data) is None
        for number in range(30):
            mutated = damaged(name, data, np.random.default_rng([7, number]))
            assert attempt(name, mutated) is None, number


@pytest.mark.parametrize("name", [*MODELS[1:], "a.3dgs.safetensors"])
def test_truncated_files(name: str) -> None:
    data = examples()[name][-1]
    for end in np.linspace(0, len(data) - 1, 20).astype(int).tolist():
        if name == "a.splat" and end and end % 32 == 0:
            continue  # a smaller model
        with pytest.raises(InputError):
            model_of_bytes(name, data[:end])


def legacy_spz(count: int, body: bytes = b"", *, version: int = 3, degree: int = 0, bits: int = 12) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, 0, 0) + body)


def with_meta(change: Callable[[dict], object]) -> bytes:
    """A .sog with a changed meta.json."""
    data = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(model_bytes("a.sog", MODEL))) as old, zipfile.ZipFile(data, "w") as new:
        meta = json.loads(old.read("meta.json"))
        change(meta)
        for name in old.namelist():
            new.writestr(name, json.dumps(meta) if name == "meta.json" else old.read(name))
    return data.getvalue()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda meta: meta["means"].update(mins=[0, 0, 1e999]), "cannot parse"),
        (lambda meta: meta["means"].update(maxs=[0, 0, 1e300]), "not finite|infinite"),
        (lambda meta: meta["means"].update(mins=[0, 0]), "no bounds of three coordinates"),
        (lambda meta: meta["scales"].update(codebook=[1e200] * 256), "not finite"),
        (lambda meta: meta["scales"].update(codebook=[0.0] * 300), "1 to 256 numbers, found 300"),
        (lambda meta: meta["scales"].pop("codebook"), "1 to 256 numbers, found 0"),
        (lambda meta: meta["quats"].update(files=[]), "fewer images"),
        (lambda meta: meta["quats"].update(files=["../../etc/passwd"]), "not a SOG: there is no"),
        (lambda meta: meta["shN"].update(count=10), "beyond the end of its palette"),
        (lambda meta: meta["shN"].update(count=10**9), "beyond the end of its palette"),
        (lambda meta: meta["shN"].update(bands=4), "degree 0 to 3"),
        (lambda meta: meta["shN"].update(bands=3), "expected an image of"),
        (lambda meta: meta.update(version=3), "expected SOG of version 2, found 3"),
        (lambda meta: meta.pop("version"), "expected SOG of version 2, found 1"),
    ],
)
def test_inconsistent_meta_json(change: Callable[[dict], object], words: str) -> None:
    refused("a.sog", with_meta(change), words)


def test_unsupported_versions() -> None:
    refused("a.spz", legacy_spz(1, bytes(100), version=1), "version 1")
    refused("a.spz", legacy_spz(1, bytes(100), version=9), "version 2 or 3")
    refused("a.spz", legacy_spz(1, bytes(900), degree=4), "degree 0 to 3")
    refused("a.spz", legacy_spz(1, bytes(100), bits=60), "fractional bits")
    refused("a.spz", gzip.compress(b"something else entirely"), "found gzip data; unpack it")


def check_one_left_out(name: str, data: bytes, attribute: str) -> None:
    said = rf"^1 of {len(MODEL)} Gaussians are left out: they have NaN or infinite values \({attribute}\)$"
    with pytest.warns(KeyssWarning, match=said):
        found = model_of_bytes(name, data)
    assert len(found) == len(MODEL) - 1
    assert found.means.isfinite().all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity(value: float) -> None:
    splat = bytearray(model_bytes("a.splat", MODEL))
    splat[4:8] = struct.pack("<f", value)
    check_one_left_out("a.splat", bytes(splat), "means")
    compressed = model_bytes("a.compressed.ply", MODEL)
    at = compressed.index(b"end_header\n") + 11
    refused("a.ply", compressed[:at] + struct.pack("<f", value) + compressed[at + 4 :], "NaN or infinite")
    binary = model_bytes("a.glb", MODEL)
    at = binary.index(b"BIN\0") + 4
    check_one_left_out("a.glb", binary[:at] + struct.pack("<f", value) + binary[at + 4 :], "means")


def with_json(change: Callable[[dict], object]) -> bytes:
    """A .glb with changed JSON."""
    data = model_bytes("a.glb", MODEL)
    (size,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    start = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return start + struct.pack("<I4s", len(text), b"JSON") + text + rest


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda gltf: gltf["nodes"][0].update(children=[0]), "its nodes are not a tree"),
        (lambda gltf: gltf["nodes"][0].update(children=[7]), "a missing part"),
        (lambda gltf: gltf["nodes"][0].update(scale=[1, 2, 1]), "by more than a similarity"),
        (lambda gltf: gltf["nodes"][0].update(scale=[0, 0, 0]), "by more than a similarity"),
        (lambda gltf: gltf["nodes"][0].update(rotation=[0, 0, 0, 0]), "no proper transform"),
        (lambda gltf: gltf["nodes"][0].update(mesh=3), "a missing part"),
        (lambda gltf: gltf["meshes"][0]["primitives"][0].pop("extensions"), "without Gaussians"),
        (lambda gltf: gltf["accessors"][2].update(bufferView=99), "a missing part"),
        (lambda gltf: gltf["accessors"][0].update(byteOffset=-4), "cannot parse the JSON"),
        (lambda gltf: gltf["accessors"][2].update(type="VEC3"), "4 numbers each"),
        (lambda gltf: gltf["accessors"][3].update(count=3), "different lengths"),
        (lambda gltf: gltf["buffers"][0].update(uri="https://example.org/a.bin"), "refers to other files"),
        (lambda gltf: gltf["bufferViews"][0].update(byteOffset=10**9), "exceeds its buffer view"),
    ],
)
def test_inconsistent_gltf(change: Callable[[dict], object], words: str) -> None:
    refused("a.glb", with_json(change), words)


def test_many_equal_gaussians(tmp_path: Path) -> None:
    """Up to 131,072 equal Gaussians may be compressed to any size."""
    model = MODEL[torch.zeros(100_000, dtype=torch.long)]
    write_model(tmp_path / "a.spz", replace(model))
    assert len(read_model(tmp_path / "a.spz")) == 100_000
