"""Other programs read our files, and we read theirs, to the same values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from files.formats.examples import assert_close, model_of
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.files.formats import glb, spz
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.spz import SpzCodes

Transform = Callable[..., Path]
DEGREES = pytest.mark.parametrize("degree", [0, 1, 2, 3])
SOME_DEGREES = pytest.mark.parametrize("degree", [0, 3])


@SOME_DEGREES
@pytest.mark.parametrize("suffix", ["spz", "sog", "compressed.ply", "splat"])
def test_splat_transform_reads_ours(
    splat_transform: Transform, tmp_path: Path, suffix: str, degree: int
) -> None:
    ours = tmp_path / f"ours.{suffix}"
    write_model(ours, model_of(600, degree))
    found = read_model(ours)
    back = read_model(splat_transform(ours, tmp_path / "back.ply"))
    # A byte b of a rotation in a .splat is b / 127.5 - 1 to it, b / 128 - 1 to the format's own viewer.
    assert_close(back, found, 1e-4 if suffix == "splat" else 1e-6)


@SOME_DEGREES
@pytest.mark.parametrize("suffix", ["spz", "sog", "compressed.ply"])
def test_we_read_splat_transforms(
    splat_transform: Transform, tmp_path: Path, suffix: str, degree: int
) -> None:
    write_model(tmp_path / "in.ply", model_of(600, degree))
    options = ["-i", "1"] if suffix == "sog" else []
    theirs = splat_transform(tmp_path / "in.ply", tmp_path / f"theirs.{suffix}", *options)
    back = read_model(splat_transform(theirs, tmp_path / "back.ply"))
    assert_close(read_model(theirs), back, 1e-6)


@SOME_DEGREES
@pytest.mark.parametrize("suffix", ["spz", "sog", "compressed.ply", "splat"])
def test_splat_transform_3_reads_ours_and_we_read_its(
    splat_transform_3: Transform, tmp_path: Path, suffix: str, degree: int
) -> None:
    ours = tmp_path / f"ours.{suffix}"
    write_model(ours, model_of(600, degree))
    there = splat_transform_3(ours, tmp_path / "there.ply")
    tolerance = 1e-4 if suffix == "splat" else 1e-6
    assert_close(as_it_turns(read_model(there), suffix), read_model(ours), tolerance)
    if suffix != "splat":
        options = ["-i", "1"] if suffix == "sog" else []
        theirs = splat_transform_3(there, tmp_path / f"theirs.{suffix}", *options)
        back = read_model(splat_transform_3(theirs, tmp_path / "back.ply"))
        assert_close(as_it_turns(back, suffix), read_model(theirs), 1e-6)


def as_it_turns(model: Gaussians, suffix: str) -> Gaussians:
    """Version 3 takes the axes of an .spz for those of a .ply; version 2 and the format's library turn it.

    By 180 degrees about x, as `dequantise` does with codes.
    """
    if suffix != "spz":
        return model
    signs = spz._SH_SIGNS[: model.sh.shape[1] - 1, None]
    sh = torch.cat([model.sh[:, :1], model.sh[:, 1:] * torch.from_numpy(signs)], dim=1)
    means = model.means * torch.tensor([1.0, -1.0, -1.0])
    return replace(model, means=means, quats=model.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]), sh=sh)


@DEGREES
def test_spz_has_the_codes_of_splat_transforms(
    splat_transform: Transform, tmp_path: Path, degree: int
) -> None:
    """It uses the format's own library."""
    model = model_of(600, degree)
    write_model(tmp_path / "in.ply", model)
    theirs = SpzCodes.parse(splat_transform(tmp_path / "in.ply", tmp_path / "a.spz").read_bytes())
    assert replace(SpzCodes.quantise(model), version=4) == theirs


@DEGREES
def test_compressed_ply_has_the_codes_of_splat_transforms(
    splat_transform: Transform, tmp_path: Path, degree: int
) -> None:
    model = model_of(600, degree)
    write_model(tmp_path / "in.ply", model)
    theirs = splat_transform(tmp_path / "in.ply", tmp_path / "a.compressed.ply").read_bytes()
    codes = CompressedPlyCodes.parse(theirs)
    order = torch.cdist(codes.dequantise().means, model.means).argmin(dim=1)
    assert len(order.unique()) == 600
    assert CompressedPlyCodes.quantise(model[order]) == codes


def test_the_order_in_chunks_is_as_good_as_splat_transforms(
    splat_transform: Transform, tmp_path: Path
) -> None:
    model = model_of(5000, 0)
    write_model(tmp_path / "in.ply", model)
    theirs = splat_transform(tmp_path / "in.ply", tmp_path / "a.compressed.ply").read_bytes()

    def extent(data: bytes) -> float:
        bounds = CompressedPlyCodes.parse(data).bounds
        return float((bounds[:, 3:6] - bounds[:, :3]).mean())

    assert extent(CompressedPlyCodes.write(model)) < 1.02 * extent(theirs)


@DEGREES
def test_we_read_splat_transforms_glb(splat_transform: Transform, tmp_path: Path, degree: int) -> None:
    """It rotates the values of a .ply by 180 degrees, and we rotate them back."""
    model = model_of(200, degree)
    write_model(tmp_path / "in.ply", model)
    found = read_model(splat_transform(tmp_path / "in.ply", tmp_path / "a.glb"))
    assert_close(found, model, 1e-6)


def of_gsply(data: gsply.GSData, *, turned: bool = False) -> Gaussians:
    """A model from gsply; `turned` rotates it from the frame of an .spz to that of a .ply."""
    n = len(data.means)
    rest = np.empty((n, 0, 3), np.float32) if data.shN is None else data.shN.reshape(n, -1, 3)
    means, quats = data.means.copy(), data.quats.copy()
    if turned:
        means[:, 1:] *= -1
        quats[:, 2:] *= -1
        signs = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
        rest = rest * signs[: rest.shape[1], None]
    sh = np.concatenate([data.sh0[:, None], rest], axis=1)
    arrays = (means, quats, data.scales, data.opacities, sh)
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(each, np.float32)) for each in arrays))


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
@pytest.mark.parametrize("version", [3, 4])
def test_we_read_gsplys_spz(tmp_path: Path, version: int, degree: int) -> None:
    write_model(tmp_path / "in.ply", model_of(300, degree))
    gsply.write_spz(tmp_path / "a.spz", gsply.plyread(tmp_path / "in.ply"), version=version)
    theirs = of_gsply(gsply.read_spz(tmp_path / "a.spz"), turned=True)
    assert_close(read_model(tmp_path / "a.spz"), theirs, 1e-5)


def test_gsplys_spz_stays_as_it_is_but_for_its_codes(tmp_path: Path) -> None:
    write_model(tmp_path / "in.ply", model_of(2000, 2))
    gsply.write_spz(tmp_path / "a.spz", gsply.plyread(tmp_path / "in.ply"), version=3)
    data = (tmp_path / "a.spz").read_bytes()
    assert SpzCodes.parse(data).serialise() == data


def test_splat_transforms_spz_stays_as_it_is_but_for_its_codes(
    splat_transform: Transform, tmp_path: Path
) -> None:
    write_model(tmp_path / "in.ply", model_of(2000, 2))
    data = splat_transform(tmp_path / "in.ply", tmp_path / "a.spz").read_bytes()
    assert SpzCodes.parse(data).serialise() == data


def test_we_read_gsplys_spz_of_version_2(tmp_path: Path) -> None:
    """It reads this version and does not write it."""
    codes = SpzCodes.quantise(model_of(300, 1))
    codes = replace(codes, version=2, largest=np.full_like(codes.largest, 3), rotations=codes.rotations & 63)
    codes = replace(codes, rotations=codes.rotations + np.uint16(100))
    (tmp_path / "a.spz").write_bytes(codes.serialise())
    assert_close(
        read_model(tmp_path / "a.spz"), of_gsply(gsply.read_spz(tmp_path / "a.spz"), turned=True), 1e-5
    )


@DEGREES
def test_we_read_gsplys_compressed_ply(tmp_path: Path, degree: int) -> None:
    write_model(tmp_path / "in.ply", model_of(300, degree))
    path = tmp_path / "a.compressed.ply"
    gsply.plywrite(path, gsply.plyread(tmp_path / "in.ply"), compressed=True)
    assert_close(read_model(path), of_gsply(gsply.plyread(path)), 1e-4)


@DEGREES
def test_glb_comes_back(degree: int) -> None:
    model = model_of(150, degree)
    found = glb.read(glb.write(model))
    assert_close(found, model, 1e-6)
    assert torch.equal(found.means, model.means)
    assert torch.equal(found.sh, model.sh)
