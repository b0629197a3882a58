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
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image

from files.formats.examples import model_of
from files.formats.mutations import attempt, damaged, examples
from keyss.core import Gaussians, InputError, KeyssWarning
from keyss.files import model_bytes, model_of_bytes, read_model, write_model
from keyss.files.formats.spz import SpzCodes
from keyss.files.ply_table import read_vertex_table
from keyss.methods.tensors import Header, unpack_tensors

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
@pytest.mark.parametrize("name", examples())
def test_damaged_files(name: str) -> None:
    for data in examples()[name]:
        assert attempt(name, data) is None
        for number in range(150):
            mutated = damaged(name, data, np.random.default_rng([7, number]))
            assert attempt(name, mutated) is None, number


@pytest.mark.parametrize("name", [name for name in examples() if name != "a.ply"])
def test_truncated_files(name: str) -> None:
    data = examples()[name][-1]
    for end in np.linspace(0, len(data) - 1, 80).astype(int).tolist():
        if name == "a.splat" and end and end % 32 == 0:
            continue  # a smaller model
        with pytest.raises(InputError):
            model_of_bytes(name, data[:end])


# --- counts that no file can hold ------------------------------------------------------------------------


def legacy_spz(count: int, body: bytes = b"", *, version: int = 3, degree: int = 0, bits: int = 12) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, 0, 0) + body)


@pytest.mark.parametrize("count", [2**31, 2**32 - 1, 10**6])
def test_counts_that_are_too_large(count: int) -> None:
    refused("a.spz", legacy_spz(count, bytes(5000)), f"it announces {count:,} Gaussians, more than")
    header = struct.pack("<4sIIBBBBI12s", b"NGSP", 4, count, 0, 12, 0, 5, 32, bytes(12))
    refused("a.spz", header + bytes(500), "it announces")
    ply = f"ply\nformat binary_little_endian 1.0\nelement chunk {count // 256}\nproperty float min_x\n"
    ply += f"element vertex {count}\nproperty uint packed_position\nend_header\n"
    refused("a.ply", ply.encode() + bytes(500), "the header announces")
    text = model_bytes("a.ply", MODEL).replace(b"binary_little_endian", b"ascii")
    refused("a.ply", text.replace(b"vertex 60", b"vertex %d" % count), "the header announces")
    with pytest.raises(InputError, match="the header announces"):
        read_vertex_table(io.BytesIO(text.replace(b"vertex 60", b"vertex %d" % count)))
    refused("a.sog", with_meta(lambda meta: meta.update(count=count)), "it announces")
    refused(
        "a.glb", with_json(lambda gltf: gltf["accessors"][0].update(count=count)), "exceeds its buffer view"
    )


def test_no_gaussians_at_all() -> None:
    refused("a.spz", legacy_spz(0), "holds no Gaussians")
    refused("a.sog", with_meta(lambda meta: meta.update(count=0)), "holds no Gaussians")
    refused("a.splat", b"", "an empty file")


# --- bombs -----------------------------------------------------------------------------------------------


def test_a_gzip_bomb() -> None:
    bomb = legacy_spz(1000, bytes(200 * MEGABYTE))
    refused("a.spz", bomb, "found more than was announced", limit=20 * MEGABYTE)
    refused("a.spz", legacy_spz(140_000, bytes(20 * 140_000)).ljust(800_000, b"\0"), "it announces 140,000")


def test_a_zstd_bomb() -> None:
    """Of a stream that is longer than the header announces, only the announced size is unpacked."""
    codes = replace(SpzCodes.quantise(MODEL), version=4)
    data = codes.serialise()
    bomb = zstandard.ZstdCompressor().compress(bytes(200 * MEGABYTE))
    old = struct.unpack_from("<Q", data, 32)[0]
    start = 32 + 6 * 16
    changed = data[:32] + struct.pack("<Q", len(bomb)) + data[40:start] + bomb + data[start + old :]
    tracemalloc.start()
    model_of_bytes("a.spz", changed)
    assert tracemalloc.get_traced_memory()[1] < 4 * MEGABYTE
    tracemalloc.stop()


def test_a_zstd_window_that_nothing_needs() -> None:
    codes = replace(SpzCodes.quantise(MODEL), version=4)
    data = bytearray(codes.serialise())
    assert data[128:134] == b"\x28\xb5\x2f\xfd" + data[132:134]  # the first frame
    flags, run = 0, struct.pack("<I", 1 | 1 << 1 | 540 << 3)[:3] + b"\0"
    for exponent, is_fine in ((13, True), (17, False)):  # 8 MiB, 128 MiB
        frame = b"\x28\xb5\x2f\xfd" + bytes([flags, exponent << 3]) + run
        old = struct.unpack_from("<Q", data, 32)[0]
        changed = data[:32] + struct.pack("<Q", len(frame)) + data[40:128] + frame + data[128 + old :]
        if is_fine:
            model_of_bytes("a.spz", bytes(changed))
        else:
            refused("a.spz", bytes(changed), "damaged SPZ")


def archive(files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression) as found:
        for name, content in files.items():
            found.writestr(name, content)
    return data.getvalue()


def contents(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        return {name: found.read(name) for name in found.namelist()}


def with_meta(change: Callable[[dict], object], **files: bytes) -> bytes:
    """A .sog with a changed meta.json, and optionally with changed files."""
    inside = contents(model_bytes("a.sog", MODEL))
    meta = json.loads(inside["meta.json"])
    change(meta)
    inside["meta.json"] = json.dumps(meta).encode()
    return archive(inside | {f"{name}.webp": content for name, content in files.items()})


def test_a_zip_bomb() -> None:
    inside = contents(model_bytes("a.sog", MODEL))
    for name in ("meta.json", "means_l.webp"):
        bomb = archive(inside | {name: bytes(200 * MEGABYTE)}, zipfile.ZIP_DEFLATED)
        refused("a.sog", bomb, "bytes that unpack to 209,7")
    lzma = archive(inside, zipfile.ZIP_LZMA)
    refused("a.sog", lzma, "unsupported ZIP compression")


def test_a_zip_bomb_behind_a_directory_that_lies() -> None:
    """A file that claims 4 GB does not make room for others, nor does one that is listed many times."""
    inside = contents(model_bytes("a.sog", MODEL)) | {"means_l.webp": bytes(200 * MEGABYTE)}
    bomb = bytearray(archive(inside | {"junk": b""}, zipfile.ZIP_DEFLATED))
    struct.pack_into("<I", bomb, bomb.rindex(b"PK\1\2") + 20, 0xFFFFFFFE)  # packed bytes of the last one
    refused("a.sog", bytes(bomb), "bytes that unpack to 209,7")
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as found:
        for name, content in contents(model_bytes("a.sog", MODEL)).items():
            found.writestr(name, content)
        found.filelist += [copy(found.filelist[0]) for _ in range(51)]
    refused("a.sog", data.getvalue(), "two of its files are at the same place")


def webp(width: int, height: int) -> bytes:
    data = io.BytesIO()
    Image.new("RGBA", (width, height)).save(data, "WEBP", lossless=True, quality=0, method=0)
    return data.getvalue()


def test_a_webp_of_huge_size() -> None:
    """A few bytes whose header announces 1 GB."""
    small = bytearray(webp(16, 16))
    small[21:25] = struct.pack("<I", 16382 | 16382 << 14)
    for image in (bytes(small), webp(4000, 4000)):
        for name in ("means_l", "quats", "shN_labels", "shN_centroids"):
            # numpy's and Python's memory is counted here, and a canvas of Pillow's is neither
            start = time.process_time()
            refused("a.sog", with_meta(lambda meta: None, **{name: image}), "damaged SOG")
            assert time.process_time() - start < 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda meta: meta["means"].update(mins=[0, 0, 1e999]), "cannot parse"),
        (lambda meta: meta["means"].update(maxs=[0, 0, 1e300]), "not finite|infinite"),
        (lambda meta: meta["means"].update(mins=[0, 0]), "no bounds of three coordinates"),
        (lambda meta: meta["scales"].update(codebook=[1e200] * 256), "not finite"),
        (lambda meta: meta["scales"].update(codebook=[0.0] * 300), "at most 256"),
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
def test_a_meta_json_that_lies(change: Callable[[dict], object], words: str) -> None:
    refused("a.sog", with_meta(change), words)


# --- versions, and numbers that are none -----------------------------------------------------------------


def test_versions_that_are_not_read() -> None:
    refused("a.spz", legacy_spz(1, bytes(100), version=1), "version 1")
    refused("a.spz", legacy_spz(1, bytes(100), version=9), "version 2 or 3")
    refused("a.spz", legacy_spz(1, bytes(900), degree=4), "degree 0 to 3")
    refused("a.spz", legacy_spz(1, bytes(100), bits=60), "fractional bits")
    refused("a.spz", gzip.compress(b"something else entirely"), "the gzip data do not hold one")


def one_left_out(name: str, data: bytes, attribute: str) -> None:
    said = rf"^1 of {len(MODEL)} Gaussians are left out: they have NaN or infinite values \({attribute}\)$"
    with pytest.warns(KeyssWarning, match=said):
        found = model_of_bytes(name, data)
    assert len(found) == len(MODEL) - 1
    assert found.means.isfinite().all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(value: float) -> None:
    splat = bytearray(model_bytes("a.splat", MODEL))
    splat[4:8] = struct.pack("<f", value)
    one_left_out("a.splat", bytes(splat), "means")
    compressed = model_bytes("a.compressed.ply", MODEL)
    at = compressed.index(b"end_header\n") + 11
    refused("a.ply", compressed[:at] + struct.pack("<f", value) + compressed[at + 4 :], "NaN or infinite")
    binary = model_bytes("a.glb", MODEL)
    at = binary.index(b"BIN\0") + 4
    one_left_out("a.glb", binary[:at] + struct.pack("<f", value) + binary[at + 4 :], "means")


def test_scales_of_zero_and_below() -> None:
    splat = bytearray(model_bytes("a.splat", MODEL))
    splat[12:16] = struct.pack("<f", 0.0)
    assert float(model_of_bytes("a.splat", bytes(splat)).log_scales.min()) < -80
    splat[12:16] = struct.pack("<f", -1.0)
    one_left_out("a.splat", bytes(splat), "log_scales")


# --- glTF ------------------------------------------------------------------------------------------------


def with_json(change: Callable[[dict], object], model: Gaussians = MODEL) -> bytes:
    data = model_bytes("a.glb", model)
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
        (lambda gltf: gltf["nodes"][0].update(children=[7]), "a part that is not there"),
        (lambda gltf: gltf["nodes"][0].update(scale=[1, 2, 1]), "by more than a similarity"),
        (lambda gltf: gltf["nodes"][0].update(scale=[0, 0, 0]), "by more than a similarity"),
        (lambda gltf: gltf["nodes"][0].update(rotation=[0, 0, 0, 0]), "no proper transform"),
        (lambda gltf: gltf["nodes"][0].update(mesh=3), "a part that is not there"),
        (lambda gltf: gltf["meshes"][0]["primitives"][0].pop("extensions"), "without Gaussians"),
        (lambda gltf: gltf["accessors"][2].update(bufferView=99), "buffer view that is not there"),
        (lambda gltf: gltf["accessors"][0].update(byteOffset=-4), "exceeds its buffer view"),
        (lambda gltf: gltf["accessors"][2].update(type="VEC3"), "4 numbers each"),
        (lambda gltf: gltf["accessors"][3].update(count=3), "different lengths"),
        (lambda gltf: gltf["buffers"][0].update(uri="https://example.org/a.bin"), "refers to other files"),
        (lambda gltf: gltf["bufferViews"][0].update(byteOffset=10**9), "exceeds its buffer view"),
    ],
)
def test_a_gltf_that_lies(change: Callable[[dict], object], words: str) -> None:
    refused("a.glb", with_json(change), words)


@pytest.mark.parametrize("where", ["inside", "instead"])
def test_spz_inside_gltf_is_named(where: str) -> None:
    name = f"KHR_gaussian_splats_{where}_spz"

    def compress(gltf: dict) -> None:
        gltf["extensionsUsed"] = [*gltf["extensionsUsed"], name]
        extensions = gltf["meshes"][0]["primitives"][0]["extensions"]
        if where == "inside":
            extensions["KHR_gaussian_splatting"]["extensions"] = {name: {"bufferView": 0}}
        else:
            extensions[name] = extensions.pop("KHR_gaussian_splatting")

    refused("a.glb", with_json(compress), rf"compressed \({name}\), .*; export a .ply or .spz")


def test_a_compression_that_is_no_extension() -> None:
    def compress(gltf: dict) -> None:
        gltf["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"] = 5

    refused("a.glb", with_json(compress), r"compressed \(unknown\)")


def test_a_gltf_that_repeats_its_gaussians_or_their_bytes() -> None:
    def with_nodes(gltf: dict) -> None:
        gltf["nodes"] = [{"mesh": 0}] * 20_000
        gltf["scenes"][0]["nodes"] = list(range(20_000))

    def with_shared_bytes(gltf: dict) -> None:
        size = gltf["buffers"][0]["byteLength"]
        gltf["bufferViews"] = [{"buffer": 0, "byteLength": size}]
        for each in gltf["accessors"]:
            each |= {"bufferView": 0, "count": size // 16, "componentType": 5121, "normalized": True}

    refused("a.glb", with_json(with_nodes), "over and over", limit=32 * MEGABYTE)
    refused("a.glb", with_json(with_shared_bytes, model_of(60, 3)), "over and over")


def test_a_gltf_of_many_empty_nodes() -> None:
    data = with_json(lambda gltf: gltf.update(nodes=[{}] * 10**6))
    refused("a.glb", data, "expected JSON of at most 1,048,576 bytes, found")


def test_many_tensors_of_no_bytes() -> None:
    """Such as a file that a key opens may announce, where 64 MiB take 1 MiB of the published model."""
    empty = {f"{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(20_000)}
    header = json.dumps(empty).encode()
    data = struct.pack("<Q", len(header)) + header
    refused("a.3dgs.safetensors", data, "a header of .* more than the")
    with pytest.raises(ValueError, match="a header of"):
        unpack_tensors(data, Header, "test", 1)


def test_nodes_move_gaussians() -> None:
    def change(gltf: dict) -> None:
        gltf["nodes"] = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]}]

    found = model_of_bytes("a.glb", with_json(change))
    expected = MODEL.means.numpy() * 2 + np.array([1, 2, 3], np.float32)
    expected[:, :2] *= -1  # from y up to y down
    assert np.allclose(found.means.numpy(), expected, atol=1e-5)
    assert np.allclose(found.log_scales.numpy(), MODEL.log_scales.numpy() + np.log(2), atol=1e-5)


def test_deep_json_is_no_problem(tmp_path: Path) -> None:
    deep = b"[" * 100_000
    refused("a.sog", archive({"meta.json": deep}), "cannot parse", limit=32 * MEGABYTE)
    with pytest.raises(InputError):
        model_of_bytes(
            "a.glb", struct.pack("<4sIII4s", b"glTF", 2, 20 + len(deep), len(deep), b"JSON") + deep
        )


def test_a_large_sparse_model_is_believed(tmp_path: Path) -> None:
    """Up to 131,072 equal Gaussians may be compressed to any size."""
    model = MODEL[torch.zeros(100_000, dtype=torch.long)]
    write_model(tmp_path / "a.spz", replace(model))
    assert len(read_model(tmp_path / "a.spz")) == 100_000
