"""`keyss convert`: other formats, what they cost, and what they would destroy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import keyss as package
from channels.quiet.trained_like import trained_like
from cli.said import Run, assert_refused, write_key
from keyss.core import Similarity
from keyss.files import read_model, write_model
from methods.carry.carried import embed
from tiny_scenes import random_gaussians

COUNT = 400
KEY = "W2mz8Qe5TnYc6LkA"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`key`, which opens carried.ply, `other`, which does not, and a plain model in several formats."""
    folder = tmp_path_factory.mktemp("convert")
    write_model(folder / "carried.ply", embed(trained_like(1500), [(KEY, trained_like(COUNT, 1))]))
    write_key(folder / "key", KEY)
    write_key(folder / "other")
    for suffix in ("ply", "spz", "sog", "compressed.ply", "glb", "splat"):
        write_model(folder / f"plain.{suffix}", random_gaussians(COUNT))
    return folder


@pytest.mark.parametrize("suffix", ["spz", "glb", "ply"])
def test_says_what_it_costs(keyss: Run, files: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out.{suffix}"
    said = keyss("convert", files / "plain.ply", out)
    assert said.status == 0
    first, *others = said.out.splitlines()
    assert first.startswith(f"{out}: {COUNT} Gaussians, {out.stat().st_size / 1e3:.1f} kB, ")
    if suffix == "ply":
        assert first.endswith("renders unchanged")
        assert not others
    else:
        if suffix == "glb":  # which has all numbers, in other units
            assert first.endswith("renders unchanged")
        else:
            assert 25 < float(first.split("renders at ")[1].split()[0]) < 100
        if suffix == "spz":
            assert others.pop(0).startswith("y is up in an .spz")
        assert others == ["a secret in low bits would be lost; --key-file checks that a secret survives"]
    assert len(read_model(out)) == COUNT


@pytest.mark.parametrize("unit", [1e-4, 1e-3, 1.0, 1e3, 1e6])
def test_sizes_beyond_spz_are_told_the_cure(keyss: Run, tmp_path: Path, unit: float) -> None:
    write_model(tmp_path / "in.ply", Similarity(unit).apply_gaussians(random_gaussians(COUNT)))
    said = keyss("convert", tmp_path / "in.ply", tmp_path / "out.spz")
    assert said.status == 0
    assert ("of the Gaussians are smaller" in said.err) == (unit in (1e-4, 1e6))
    psnr = float(said.out.split("renders at ")[1].split()[0])
    if unit in (1e-4, 1e6):
        factor = float(said.err.split(" -s ")[1].split()[0])
        write_model(tmp_path / "in.ply", Similarity(factor * unit).apply_gaussians(random_gaussians(COUNT)))
        said = keyss("convert", tmp_path / "in.ply", tmp_path / "scaled.spz")
        assert "smaller" not in said.err
        assert float(said.out.split("renders at ")[1].split()[0]) > psnr + 10
    else:
        assert psnr > 30


@pytest.mark.parametrize("unit", [1e-5, 1e4])
def test_the_cost_does_not_depend_on_the_unit(keyss: Run, tmp_path: Path, unit: float) -> None:
    """Also of models that are smaller than the nearest distance that rasterizers draw."""
    generator = torch.Generator().manual_seed(2)
    model = random_gaussians(COUNT)
    model = replace(model, log_scales=torch.randn(COUNT, 3, generator=generator) * 0.5 - 2)
    costs = []
    for name, scale in (("one", 1.0), ("other", unit)):
        changed = Similarity(scale=scale).apply_gaussians(model)
        write_model(tmp_path / f"{name}.ply", changed)
        said = keyss("convert", tmp_path / f"{name}.ply", tmp_path / f"{name}.compressed.ply").out
        costs.append(float(said.split("renders at ")[1].split()[0]))
    assert costs[0] == pytest.approx(costs[1], abs=1.0)
    said = keyss("convert", tmp_path / "other.ply", tmp_path / "other.spz")
    assert "unchanged" not in said.out
    assert len(read_model(tmp_path / "other.spz").means.unique(dim=0)) == COUNT or unit < 1e-4


@pytest.mark.parametrize("suffix", ["sog", "compressed.ply"])
def test_every_verb_that_takes_models_takes_each_format(keyss: Run, files: Path, suffix: str) -> None:
    path = files / f"plain.{suffix}"
    assert f"{COUNT:,}" in keyss("info", path).out
    assert keyss("verify", path).status == 0
    assert keyss("reveal", path, "--key-file", files / "other", "-o", files / "none.ply").status == 3
    out = files / f"{suffix}.pictures"
    assert keyss("render", path, "--cameras", path, "--width", "20", "-o", out).status == 0
    assert list(out.iterdir())


def test_a_secret_is_not_destroyed_unasked(keyss: Run, files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.spz"
    convert = ("convert", files / "carried.ply", out, "--key-file", files / "key")
    refused = keyss(*convert)
    assert_refused(refused, 7, "Gaussians would be left in")
    assert "nothing was written; --force writes it anyway" in refused.err
    assert not out.exists()
    assert "is lost: 0 Gaussians are left" in keyss(*convert, "--dry-run").out
    assert not out.exists()
    assert keyss(*convert, "--force").status == 0
    assert out.exists()


def test_a_secret_survives_from_ply_to_ply(keyss: Run, files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    said = keyss("convert", files / "carried.ply", out, "--key-file", files / "key")
    assert said.status == 0
    assert "Gaussians, survives" in said.out
    assert keyss("reveal", out, "--key-file", files / "key", "-o", tmp_path / "secret.ply").status == 0


def test_a_hidden_file_is_not_destroyed_unasked(keyss: Run, files: Path, tmp_path: Path) -> None:
    stego = package.hide_files(
        trained_like(2500), [package.SecretFile(b"a letter" * 20, "q7Rv2LxT9bWm4KzD")]
    ).stego
    write_model(tmp_path / "stego.ply", stego)
    key = ("--key-file", files / "other")
    refused = keyss("convert", tmp_path / "stego.ply", tmp_path / "out.sog", *key)
    assert_refused(refused, 7, "0 of its 160 bytes would be left in")
    said = keyss("convert", tmp_path / "stego.ply", tmp_path / "out.ply", *key)
    assert "160 bytes, survives" in said.out


def test_a_key_that_opens_nothing(keyss: Run, files: Path, tmp_path: Path) -> None:
    said = keyss("convert", files / "carried.ply", tmp_path / "o.ply", "--key-file", files / "other")
    assert_refused(said, 3, "opens nothing here")


def test_what_is_refused(keyss: Run, files: Path, tmp_path: Path) -> None:
    plain = files / "plain.ply"
    assert_refused(keyss("convert", plain, tmp_path / "a.lcc"), 2, "expected a name that ends in")
    assert_refused(keyss("convert", files / "key", tmp_path / "a.ply"), 4, "expected a 3DGS model")
    (tmp_path / "there.spz").touch()
    assert_refused(keyss("convert", plain, tmp_path / "there.spz"), 5, "exists")
    assert keyss("convert", plain, tmp_path / "there.spz", "--overwrite").status == 0
    arguments = ("--cover", plain, "--secret", plain, "--method", "carry", "--key-file", files / "key")
    assert_refused(keyss("hide", *arguments, "-o", tmp_path / "a.spz"), 2, "expected the name of a folder")


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_others_can_read_what_is_made_of_what_they_can_read(keyss: Run, tmp_path: Path, mode: int) -> None:
    write_model(tmp_path / "m.ply", random_gaussians(50))
    (tmp_path / "m.ply").chmod(mode)
    assert keyss("convert", tmp_path / "m.ply", tmp_path / "m.spz").status == 0
    assert keyss("view", tmp_path / "m.ply", "-o", tmp_path / "page.html").status == 0
    assert keyss("view", tmp_path / "m.ply", "-o", tmp_path / "page").status == 0
    made = [tmp_path / "m.spz", tmp_path / "page.html", *(tmp_path / "page").iterdir()]
    assert {path.stat().st_mode & 0o777 for path in made} == {mode}


def test_the_folder_of_a_training_is_a_model(keyss: Run, tmp_path: Path) -> None:
    for number in (7000, 30000):
        folder = tmp_path / "trained" / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        write_model(folder / "point_cloud.ply", trained_like(COUNT + number // 10))
    said = keyss("convert", tmp_path / "trained", tmp_path / "a.spz")
    assert said.err.count("its model is point_cloud/iteration_30000/point_cloud.ply") == 1
    assert len(read_model(tmp_path / "a.spz")) == COUNT + 3000
    write_model(tmp_path / "secret.ply", trained_like(60, 1))
    key, run = write_key(tmp_path / "key"), tmp_path / "run"
    options = ["--secret", tmp_path / "secret.ply", "--key-file", key, "--min-psnr", "0", "-o", run]
    said = keyss("hide", "--cover", tmp_path / "trained", *options)
    assert said.status == 0, said.err
    assert said.err.count("its model is") == 1
    assert len(read_model(run / "publish" / "model.ply")) == COUNT + 3000
    assert keyss("evaluate", run, "--key-file", key).status == 0
