"""`keyss convert`: quality, lost secrets, refusals."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import keyss as package
from channels.lsb.trained_like import trained_like
from cli.harness import Run, assert_refused, write_key
from keyss.core import Similarity
from keyss.files import FORMATS, read_model, write_model
from methods.carry.carried import embed
from tiny_scenes import random_gaussians

COUNT = 400
KEY = "W2mz8Qe5TnYc6LkA"


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`key` opens carried.ply, `other` does not; a plain model in several formats."""
    folder = tmp_path_factory.mktemp("convert")
    write_model(folder / "carried.ply", embed(trained_like(1500), [(KEY, trained_like(COUNT, 1))]))
    write_key(folder / "key", KEY)
    write_key(folder / "other")
    for suffix in (suffix for model_format in FORMATS for suffix in model_format.suffixes):
        write_model(folder / f"plain{suffix}", random_gaussians(COUNT))
    return folder


@pytest.fixture(autouse=True)
def folder(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of each test, with links to the files."""
    for path in models.iterdir():
        os.link(path, tmp_path / path.name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def psnr_of(out: str) -> float:
    return float(out.split("renders at ")[1].split()[0])


@pytest.mark.parametrize("suffix", ["spz", "glb", "ply"])
def test_reports_quality(keyss: Run, suffix: str) -> None:
    out = Path(f"out.{suffix}")
    result = keyss(f"convert plain.ply -o {out}")
    assert result.status == 0
    first, *others = result.out.splitlines()
    assert first.startswith(f"{out}: {COUNT} Gaussians, {out.stat().st_size / 1e3:.1f} kB, ")
    if suffix == "ply":
        assert first.endswith("renders the same")  # from 120 dB on
        assert not others
    else:
        if suffix == "spz":
            assert 25 < psnr_of(first) < 100
        else:  # opacities instead of their logits: rounded to float32, 6e-8, in each conversion
            assert first.endswith("renders the same") or psnr_of(first) > 110
        assert others == ["secrets of --publish unchanged, if any, are lost; --key-file checks one"]
    assert len(read_model(out)) == COUNT


@pytest.mark.parametrize("unit", [1e-4, 1e-3, 1.0, 1e3, 1e6])
def test_spz_scale_warning(keyss: Run, folder: Path, unit: float) -> None:
    write_model(folder / "in.ply", Similarity(unit).apply_gaussians(random_gaussians(COUNT)))
    result = keyss("convert in.ply -o out.spz")
    assert result.status == 0
    assert ("of the Gaussians are smaller" in result.err) == (unit in (1e-4, 1e6))
    if unit not in (1e-4, 1e6):
        assert psnr_of(result.out) > 30
        return
    factor = float(result.err.split(" -s ")[1].split()[0])
    write_model(folder / "in.ply", Similarity(factor * unit).apply_gaussians(random_gaussians(COUNT)))
    scaled = keyss("convert in.ply -o scaled.spz")
    assert "smaller" not in scaled.err
    assert psnr_of(scaled.out) > psnr_of(result.out) + 10


def test_losing_a_secret_needs_force(keyss: Run) -> None:
    convert = "convert carried.ply -o out.spz --key-file key"
    refused = keyss(convert)
    assert_refused(refused, 7, "Gaussians would be left in")
    cures = "by the method carry with --publish converted or --format spz, or convert the model without it"
    assert f"hide it {cures}: --force" in refused.err
    assert "is lost: 0 Gaussians are left" in keyss(f"{convert} --dry-run").out
    assert not Path("out.spz").exists()
    assert keyss(f"{convert} --force").status == 0
    assert Path("out.spz").exists()


def test_published_models_need_a_key_or_force(keyss: Run) -> None:
    """A run tells that its file holds a secret, and nothing else does."""
    package.hide(trained_like(1500), [package.Secret(trained_like(COUNT, 1), KEY)], out="run")
    convert = "convert run/publish/model.ply -o out.spz"
    assert_refused(keyss(convert), 7, "with a secret, which this format may destroy: give its --key-file")
    assert "would be lost" in keyss(f"{convert} --dry-run").out
    assert keyss(f"{convert} --force").status == 0
    assert keyss("convert run/publish/model.ply -o out.ply").status == 0
    Path("run/publish/model.ply").rename("moved.ply")
    assert "are lost" in keyss("convert moved.ply -o out.spz --overwrite").out


def test_secret_survives_ply_to_ply(keyss: Run) -> None:
    result = keyss("convert carried.ply -o out.ply --key-file key")
    assert result.status == 0
    assert "Gaussians, survives" in result.out
    assert keyss("reveal out.ply --key-file key -o secret.ply").status == 0


def test_losing_a_hidden_file_needs_force(keyss: Run, folder: Path) -> None:
    stego = package.hide(trained_like(2500), [package.SecretFile(b"a letter" * 20, "q7Rv2LxT9bWm4KzD")]).stego
    write_model(folder / "stego.ply", stego)
    refused = keyss("convert stego.ply -o out.sog --key-file other")
    assert_refused(refused, 7, "0 of its 160 bytes would be left in")
    assert "160 bytes, survives" in keyss("convert stego.ply -o out.ply --key-file other").out


def test_invalid_outputs(keyss: Run) -> None:
    for status, words, command in (
        (2, "expected a name that ends in", "convert plain.ply -o a.lcc"),
        (4, "expected a 3DGS model", "convert key -o a.ply"),
        (3, "opens nothing", "convert carried.ply -o a.ply --key-file other"),
        (5, "exists", "convert plain.ply -o carried.ply"),
        (2, "the name of a folder", "hide --cover plain.ply --secret plain.ply --key-file key -o a.spz"),
    ):
        assert_refused(keyss(command), status, words)
    assert keyss("convert plain.ply -o plain.spz --overwrite").status == 0


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_output_keeps_permissions(keyss: Run, folder: Path, mode: int) -> None:
    write_model(folder / "m.ply", random_gaussians(50))
    (folder / "m.ply").chmod(mode)
    for command in ("convert m.ply -o m.spz", "view m.ply -o page.html", "view m.ply -o page"):
        assert keyss(command).status == 0
    made = [folder / "m.spz", folder / "page.html", *(folder / "page").iterdir()]
    assert {path.stat().st_mode & 0o777 for path in made} == {mode}


def test_training_folder_as_model(keyss: Run) -> None:
    for number in (7000, 30000):
        folder = Path(f"trained/point_cloud/iteration_{number}")
        folder.mkdir(parents=True)
        write_model(folder / "point_cloud.ply", trained_like(COUNT + number // 10))
    result = keyss("convert trained -o a.spz")
    assert result.err.count("its model is point_cloud/iteration_30000/point_cloud.ply") == 1
    assert len(read_model("a.spz")) == COUNT + 3000
