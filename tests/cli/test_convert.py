"""`keyss convert`: quality, lost secrets, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

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
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`key` opens carried.ply, `other` does not; a plain model in several formats."""
    folder = tmp_path_factory.mktemp("convert")
    write_model(folder / "carried.ply", embed(trained_like(1500), [(KEY, trained_like(COUNT, 1))]))
    write_key(folder / "key", KEY)
    write_key(folder / "other")
    for suffix in (suffix for model_format in FORMATS for suffix in model_format.suffixes):
        write_model(folder / f"plain{suffix}", random_gaussians(COUNT))
    return folder


@pytest.mark.parametrize("suffix", ["spz", "glb", "ply"])
def test_reports_quality(keyss: Run, files: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out.{suffix}"
    result = keyss("convert", files / "plain.ply", "-o", out)
    assert result.status == 0
    first, *others = result.out.splitlines()
    assert first.startswith(f"{out}: {COUNT} Gaussians, {out.stat().st_size / 1e3:.1f} kB, ")
    same = first.endswith("renders the same")  # from 120 dB on
    psnr = 120.0 if same else float(first.split("renders at ")[1].split()[0])
    if suffix == "ply":
        assert same
        assert not others
    else:
        if suffix == "glb":  # opacities instead of their logits: rounded to float32, 6e-8, in each conversion
            assert psnr > 110
        else:
            assert 25 < psnr < 100
        assert others == ["secrets of --publish unchanged, if any, are lost; --key-file checks one"]
    assert len(read_model(out)) == COUNT


@pytest.mark.parametrize("unit", [1e-4, 1e-3, 1.0, 1e3, 1e6])
def test_spz_scale_warning(keyss: Run, tmp_path: Path, unit: float) -> None:
    write_model(tmp_path / "in.ply", Similarity(unit).apply_gaussians(random_gaussians(COUNT)))
    result = keyss("convert", tmp_path / "in.ply", "-o", tmp_path / "out.spz")
    assert result.status == 0
    assert ("of the Gaussians are smaller" in result.err) == (unit in (1e-4, 1e6))
    psnr = float(result.out.split("renders at ")[1].split()[0])
    if unit in (1e-4, 1e6):
        factor = float(result.err.split(" -s ")[1].split()[0])
        write_model(tmp_path / "in.ply", Similarity(factor * unit).apply_gaussians(random_gaussians(COUNT)))
        result = keyss("convert", tmp_path / "in.ply", "-o", tmp_path / "scaled.spz")
        assert "smaller" not in result.err
        assert float(result.out.split("renders at ")[1].split()[0]) > psnr + 10
    else:
        assert psnr > 30


@pytest.mark.parametrize("unit", [1e-5, 1e4])
def test_quality_is_scale_invariant(keyss: Run, tmp_path: Path, unit: float) -> None:
    """Models smaller than the near plane of rasterizers included."""
    generator = torch.Generator().manual_seed(2)
    model = random_gaussians(COUNT)
    model = replace(model, log_scales=torch.randn(COUNT, 3, generator=generator) * 0.5 - 2)
    costs = []
    for name, scale in (("one", 1.0), ("other", unit)):
        changed = Similarity(scale=scale).apply_gaussians(model)
        write_model(tmp_path / f"{name}.ply", changed)
        result = keyss("convert", tmp_path / f"{name}.ply", "-o", tmp_path / f"{name}.compressed.ply").out
        costs.append(float(result.split("renders at ")[1].split()[0]))
    assert costs[0] == pytest.approx(costs[1], abs=1.0)
    result = keyss("convert", tmp_path / "other.ply", "-o", tmp_path / "other.spz")
    assert "renders the same" not in result.out
    assert len(read_model(tmp_path / "other.spz").means.unique(dim=0)) == COUNT or unit < 1e-4


@pytest.mark.parametrize("suffix", ["sog", "compressed.ply"])
def test_verbs_accept_every_format(keyss: Run, files: Path, suffix: str) -> None:
    path = files / f"plain.{suffix}"
    assert f"{COUNT:,}" in keyss("info", path).out
    assert keyss("verify", path).status == 0
    assert keyss("reveal", path, "--key-file", files / "other", "-o", files / "none.ply").status == 3
    out = files / f"{suffix}.pictures"
    assert keyss("render", path, "--cameras", path, "--width", "20", "-o", out).status == 0
    assert list(out.iterdir())


def test_losing_a_secret_needs_force(keyss: Run, files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.spz"
    convert = ("convert", files / "carried.ply", "-o", out, "--key-file", files / "key")
    refused = keyss(*convert)
    assert_refused(refused, 7, "Gaussians would be left in")
    cures = "by the method carry with --publish converted or --format spz, or convert the model without it"
    assert f"hide it {cures}: --force" in refused.err
    assert not out.exists()
    assert "is lost: 0 Gaussians are left" in keyss(*convert, "--dry-run").out
    assert not out.exists()
    assert keyss(*convert, "--force").status == 0
    assert out.exists()


def test_published_models_need_a_key_or_force(keyss: Run, files: Path, tmp_path: Path) -> None:
    """A run tells that its file holds a secret, and nothing else does."""
    out = tmp_path / "run"
    package.hide(trained_like(1500), [package.Secret(trained_like(COUNT, 1), KEY)], out=out)
    model = out / "publish" / "model.ply"
    convert = ("convert", model, "-o", tmp_path / "out.spz")
    assert_refused(keyss(*convert), 7, "with a secret, which this format may destroy: give its --key-file")
    assert "would be lost" in keyss(*convert, "--dry-run").out
    assert keyss(*convert, "--force").status == 0
    assert keyss("convert", model, "-o", tmp_path / "out.ply").status == 0
    model.rename(tmp_path / "moved.ply")
    convert = ("convert", tmp_path / "moved.ply", "-o", tmp_path / "out.spz", "--overwrite")
    assert "are lost" in keyss(*convert).out


def test_secret_survives_ply_to_ply(keyss: Run, files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    result = keyss("convert", files / "carried.ply", "-o", out, "--key-file", files / "key")
    assert result.status == 0
    assert "Gaussians, survives" in result.out
    assert keyss("reveal", out, "--key-file", files / "key", "-o", tmp_path / "secret.ply").status == 0


def test_losing_a_hidden_file_needs_force(keyss: Run, files: Path, tmp_path: Path) -> None:
    stego = package.hide(trained_like(2500), [package.SecretFile(b"a letter" * 20, "q7Rv2LxT9bWm4KzD")]).stego
    write_model(tmp_path / "stego.ply", stego)
    key = ("--key-file", files / "other")
    refused = keyss("convert", tmp_path / "stego.ply", "-o", tmp_path / "out.sog", *key)
    assert_refused(refused, 7, "0 of its 160 bytes would be left in")
    result = keyss("convert", tmp_path / "stego.ply", "-o", tmp_path / "out.ply", *key)
    assert "160 bytes, survives" in result.out


def test_invalid_outputs(keyss: Run, files: Path, tmp_path: Path) -> None:
    plain = files / "plain.ply"
    assert_refused(keyss("convert", plain, "-o", tmp_path / "a.lcc"), 2, "expected a name that ends in")
    assert_refused(keyss("convert", files / "key", "-o", tmp_path / "a.ply"), 4, "expected a 3DGS model")
    wrong_key = ("--key-file", files / "other")
    assert_refused(
        keyss("convert", files / "carried.ply", "-o", tmp_path / "a.ply", *wrong_key), 3, "opens nothing"
    )
    (tmp_path / "there.spz").touch()
    assert_refused(keyss("convert", plain, "-o", tmp_path / "there.spz"), 5, "exists")
    assert keyss("convert", plain, "-o", tmp_path / "there.spz", "--overwrite").status == 0
    arguments = ("--cover", plain, "--secret", plain, "--method", "carry", "--key-file", files / "key")
    assert_refused(keyss("hide", *arguments, "-o", tmp_path / "a.spz"), 2, "expected the name of a folder")


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_output_keeps_permissions(keyss: Run, tmp_path: Path, mode: int) -> None:
    write_model(tmp_path / "m.ply", random_gaussians(50))
    (tmp_path / "m.ply").chmod(mode)
    assert keyss("convert", tmp_path / "m.ply", "-o", tmp_path / "m.spz").status == 0
    assert keyss("view", tmp_path / "m.ply", "-o", tmp_path / "page.html").status == 0
    assert keyss("view", tmp_path / "m.ply", "-o", tmp_path / "page").status == 0
    made = [tmp_path / "m.spz", tmp_path / "page.html", *(tmp_path / "page").iterdir()]
    assert {path.stat().st_mode & 0o777 for path in made} == {mode}


def test_training_folder_as_model(keyss: Run, tmp_path: Path) -> None:
    for number in (7000, 30000):
        folder = tmp_path / "trained" / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        write_model(folder / "point_cloud.ply", trained_like(COUNT + number // 10))
    result = keyss("convert", tmp_path / "trained", "-o", tmp_path / "a.spz")
    assert result.err.count("its model is point_cloud/iteration_30000/point_cloud.ply") == 1
    assert len(read_model(tmp_path / "a.spz")) == COUNT + 3000


def test_converting_low_bits_beside_appended_gaussians_is_refused(
    keyss: Run, files: Path, tmp_path: Path
) -> None:
    write_model(tmp_path / "cover.ply", trained_like(1500))
    write_model(tmp_path / "secret.ply", trained_like(20, 1))
    cover = tmp_path / "cover.ply"
    for name, publish, how in (("a", "converted", "; it may be converted"), ("b", "unchanged", " unchanged")):
        scenes = ("--cover", cover, "--secret", tmp_path / "secret.ply", "--key-file", files / "key")
        options = ("--publish", publish, "--width", 24, "--min-psnr", 0)
        result = keyss("hide", *scenes, *options, "-o", tmp_path / name)
        assert result.status == 0, result.err
        assert f"publish this file{how}: " in result.out
        cover = tmp_path / name / "publish" / "model.ply"
