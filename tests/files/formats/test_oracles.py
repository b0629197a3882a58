"""Other programs read our files, and we read theirs, to the same values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import gsply
import gsply.spz
import numpy as np
import pytest
import torch

from files.formats.examples import assert_close, model_of, same_codes
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.files.formats import glb
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.spz import SpzCodes

Transform = Callable[..., Path]
NEWER = Path(__file__).parents[3] / "web" / "node_modules" / ".bin" / "splat-transform"
DEGREES = pytest.mark.parametrize("degree", [0, 1, 2, 3])
TRANSFORMS = [
    *product((2, 3), ("spz", "compressed.ply", "splat"), (0, 3)),
    (2, "sog", 3),
    *(pytest.param(*each, marks=pytest.mark.slow) for each in ((2, "sog", 0), (3, "sog", 0), (3, "sog", 3))),
]


@pytest.mark.parametrize(("version", "suffix", "degree"), TRANSFORMS)
def test_splat_transform_interoperates(
    splat_transform: Transform,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    version: int,
    suffix: str,
    degree: int,
) -> None:
    if version == 3:
        if not NEWER.exists():
            pytest.skip("no web/node_modules: `make test-web` installs splat-transform 3")
        monkeypatch.setenv("KEYSS_SPLAT_TRANSFORM", str(NEWER))
    turned = suffix == "spz" and version == 3
    ours = tmp_path / f"ours.{suffix}"
    write_model(ours, model_of(600, degree))
    there = splat_transform(ours, tmp_path / "there.ply")
    # It decodes a byte b of a rotation in a .splat as b / 127.5 - 1, the format's own viewer as b / 128 - 1.
    tolerance = 1e-4 if suffix == "splat" else 1e-6
    assert_close(rotate(read_model(there)) if turned else read_model(there), read_model(ours), tolerance)
    if suffix != "splat":
        options = ["-i", "1"] if suffix == "sog" else []
        theirs = splat_transform(there, tmp_path / f"theirs.{suffix}", *options)
        back = read_model(splat_transform(theirs, tmp_path / "back.ply"))
        assert_close(rotate(back) if turned else back, read_model(theirs), 1e-6)


def rotate(model: Gaussians) -> Gaussians:
    """`model` rotated by 180 degrees about x: version 3 takes the axes of an .spz for those of a .ply."""
    signs = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
    rest = model.sh[:, 1:] * torch.from_numpy(signs[: model.sh.shape[1] - 1, None])
    means = model.means * torch.tensor([1.0, -1.0, -1.0])
    quats = model.quats * torch.tensor([1.0, 1.0, -1.0, -1.0])
    return replace(model, means=means, quats=quats, sh=torch.cat([model.sh[:, :1], rest], dim=1))


@DEGREES
def test_spz_codes_match_splat_transform(splat_transform: Transform, tmp_path: Path, degree: int) -> None:
    """It uses the format's own library."""
    model = model_of(600, degree)
    write_model(tmp_path / "in.ply", model)
    theirs = SpzCodes.parse(splat_transform(tmp_path / "in.ply", tmp_path / "a.spz").read_bytes())
    assert same_codes(replace(SpzCodes.quantise(model), version=4), theirs)


@DEGREES
def test_compressed_ply_codes_match_splat_transform(
    splat_transform: Transform, tmp_path: Path, degree: int
) -> None:
    model = model_of(600, degree)
    write_model(tmp_path / "in.ply", model)
    theirs = splat_transform(tmp_path / "in.ply", tmp_path / "a.compressed.ply").read_bytes()
    codes = CompressedPlyCodes.parse(theirs)
    order = torch.cdist(codes.dequantise().means, model.means).argmin(dim=1)
    assert len(order.unique()) == 600
    assert same_codes(CompressedPlyCodes.quantise(model[order]), codes)


def test_chunks_are_as_compact_as_splat_transforms(splat_transform: Transform, tmp_path: Path) -> None:
    model = model_of(5000, 0)
    write_model(tmp_path / "in.ply", model)
    theirs = splat_transform(tmp_path / "in.ply", tmp_path / "a.compressed.ply").read_bytes()

    def extent(data: bytes) -> float:
        bounds = CompressedPlyCodes.parse(data).bounds
        return float((bounds[:, 3:6] - bounds[:, :3]).mean())

    assert extent(CompressedPlyCodes.write(model)) < 1.02 * extent(theirs)


@DEGREES
def test_reads_splat_transform_glb(splat_transform: Transform, tmp_path: Path, degree: int) -> None:
    """It rotates the values of a .ply by 180 degrees, and we rotate them back."""
    model = model_of(200, degree)
    write_model(tmp_path / "in.ply", model)
    found = read_model(splat_transform(tmp_path / "in.ply", tmp_path / "a.glb"))
    assert_close(found, model, 1e-6)


def of_gsply(data: gsply.GSData, *, turned: bool = False) -> Gaussians:
    """A model from gsply; `turned` rotates it from the frame of an .spz to that of a .ply."""
    n = len(data.means)
    rest = np.empty((n, 0, 3), np.float32) if data.shN is None else data.shN.reshape(n, -1, 3)
    sh = np.concatenate([data.sh0[:, None], rest], axis=1)
    arrays = (data.means, data.quats, data.scales, data.opacities, sh)
    model = Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays))
    return rotate(model) if turned else model


GSPLY: dict[str, Callable[[Path], gsply.GSData]] = {
    "spz": gsply.read_spz,
    "sog": gsply.sogread,
    "compressed.ply": gsply.plyread,
}


@DEGREES
@pytest.mark.parametrize("suffix", GSPLY)
def test_gsply_reads_ours(tmp_path: Path, suffix: str, degree: int) -> None:
    path = tmp_path / f"ours.{suffix}"
    write_model(path, model_of(300, degree))
    # Of opacities of 0 and 1 it makes others that are finite, too.
    assert_close(of_gsply(GSPLY[suffix](path), turned=suffix == "spz"), read_model(path), 1e-4)


@DEGREES
@pytest.mark.parametrize(("suffix", "version"), [("spz", 3), ("spz", 4), ("compressed.ply", 0)])
def test_we_read_gsplys(tmp_path: Path, suffix: str, version: int, degree: int) -> None:
    write_model(tmp_path / "in.ply", model_of(300, degree))
    path, data = tmp_path / f"a.{suffix}", gsply.plyread(tmp_path / "in.ply")
    if version:
        gsply.write_spz(path, data, version=version)
    else:
        gsply.plywrite(path, data, compressed=True)
    theirs = of_gsply(GSPLY[suffix](path), turned=suffix == "spz")
    assert_close(read_model(path), theirs, 1e-5 if version else 1e-4)


def test_reads_gsply_spz_version_2(tmp_path: Path) -> None:
    """It reads this version and does not write it."""
    codes = SpzCodes.quantise(model_of(300, 1))
    codes = replace(codes, version=2, largest=np.full_like(codes.largest, 3), rotations=codes.rotations & 63)
    codes = replace(codes, rotations=codes.rotations + np.uint16(100))
    (tmp_path / "a.spz").write_bytes(codes.serialise())
    assert_close(
        read_model(tmp_path / "a.spz"), of_gsply(gsply.read_spz(tmp_path / "a.spz"), turned=True), 1e-5
    )


@DEGREES
def test_glb_round_trip(degree: int) -> None:
    model = model_of(150, degree)
    found = glb.read(glb.write(model))
    assert_close(found, model, 1e-6)
    assert torch.equal(found.means, model.means)
    assert torch.equal(found.sh, model.sh)


@pytest.mark.parametrize("name", ["spz", "compressed.ply"])
def test_splat_transform_files_round_trip(splat_transform: Transform, tmp_path: Path, name: str) -> None:
    write_model(tmp_path / "model.ply", model_of(5000, 3))
    data = splat_transform(tmp_path / "model.ply", tmp_path / f"file.{name}").read_bytes()
    kind = SpzCodes if name == "spz" else CompressedPlyCodes
    assert kind.parse(data).serialise() == data


@pytest.mark.parametrize(("version", "count"), [(3, 5000), (3, 40_000), (4, 5000)])
def test_gsply_files_round_trip(tmp_path: Path, version: int, count: int) -> None:
    """Above 1 MiB, gsply compresses blocks on their own."""
    write_model(tmp_path / "model.ply", model_of(count, 3))
    gsply.spz.write_spz(tmp_path / "file.spz", gsply.plyread(str(tmp_path / "model.ply")), version=version)
    data = (tmp_path / "file.spz").read_bytes()
    assert SpzCodes.parse(data).serialise() == data
