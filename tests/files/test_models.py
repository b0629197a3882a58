"""The choice of a model format, new formats, and `info` on models."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import pytest
import torch
from safetensors.torch import load, save

from keyss import info
from keyss.core import Gaussians, InputError, OutputError, UsageError
from keyss.files import check_model_output, is_model_path, keeps_low_bits, models, read_model, write_model
from keyss.files.models import ModelFormat
from keyss.runs import ModelInfo
from tiny_scenes import random_gaussians

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def write_toy(model: Gaussians, file: BinaryIO) -> None:
    file.write(b"TOY!" + save({name: getattr(model, name).contiguous() for name in FIELDS}))


def read_toy(file: BinaryIO) -> Gaussians:
    return Gaussians(**load(file.read().removeprefix(b"TOY!")))


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new format: one more entry of the list."""
    entry = ModelFormat("toy", (".toy", ".toy.bin"), (b"TOY!",), read_toy, write_toy)
    monkeypatch.setattr(models, "FORMATS", [*models.FORMATS, entry])


def test_new_format(toy: None, tmp_path: Path) -> None:
    model = random_gaussians(9, sh_degree=2)
    for name, kind in (("a.toy", "toy"), ("b.TOY.bin", "toy"), ("c.ply", "PLY"), ("d.Ply", "PLY")):
        path = tmp_path / name
        assert is_model_path(path)
        write_model(path, model)
        assert path.read_bytes().startswith(b"TOY!" if kind == "toy" else b"ply\n")
        assert read_model(path).digest() == model.digest()


def test_format_from_content(toy: None, tmp_path: Path) -> None:
    model = random_gaussians(5)
    for suffix in (".ply", ".toy"):
        write_model(tmp_path / f"a{suffix}", model)
        renamed = (tmp_path / f"a{suffix}").rename(tmp_path / "download")
        assert not is_model_path(renamed)
        assert read_model(renamed).digest() == model.digest()


def test_suffix_of_another_format(toy: None, tmp_path: Path) -> None:
    write_model(tmp_path / "a.toy", random_gaussians(5))
    path = (tmp_path / "a.toy").rename(tmp_path / "a.ply")
    with pytest.raises(
        InputError, match=r"a\.ply: the name says PLY, but the content is toy; .* end in \.toy"
    ):
        read_model(path)


@pytest.mark.parametrize("name", ["a.lcc", "a", "ply", "a.ply.txt"])
def test_unknown_suffixes(tmp_path: Path, name: str) -> None:
    assert not is_model_path(name)
    for write in (lambda path: write_model(path, random_gaussians(5)), lambda p: check_model_output(p, True)):
        with pytest.raises(
            UsageError,
            match=rf"{name}: expected .* ends in \.compressed\.ply, \.ply, \.spz, \.sog, \.glb, \.splat$",
        ):
            write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply", ".glb", ".splat"])
def test_every_format_round_trips(tmp_path: Path, suffix: str) -> None:
    model = random_gaussians(40, sh_degree=1)
    path = tmp_path / f"a{suffix}"
    write_model(path, model)
    assert is_model_path(path)
    assert not keeps_low_bits(path)
    assert len(read_model(path)) == 40
    if suffix != ".splat":  # which has no first bytes of its own
        assert read_model(path).digest() == read_model(path.rename(tmp_path / "download")).digest()


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply", ".glb", ".splat"])
def test_invalid_models_are_not_written(tmp_path: Path, suffix: str) -> None:
    model = random_gaussians(40)
    with pytest.raises(OutputError, match="holds no Gaussians"):
        write_model(tmp_path / f"a{suffix}", model[:0])
    model.means[3] = torch.nan
    with pytest.raises(OutputError, match="NaN or infinite values in means"):
        write_model(tmp_path / f"a{suffix}", model)
    model.means[3] = 0
    model.opacity_logits[4] = torch.inf
    write_model(tmp_path / f"a{suffix}", model)
    assert float(read_model(tmp_path / f"a{suffix}").opacity_logits.max()) > 15


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("suffix", ["ply", "PLY", "compressed.ply", "glb"])
def test_info_matches_the_model(tmp_path: Path, suffix: str, degree: int) -> None:
    """A plain .ply is read without torch, other formats by `read_model`, which is the oracle."""
    path = tmp_path / f"model.{suffix}"
    made = random_gaussians(500, sh_degree=degree)
    logits = made.opacity_logits.clone()
    logits[:5] = torch.tensor([torch.inf, -torch.inf, -16.0, -2.95, -2.94])  # 0.05 lies between the last two
    write_model(path, Gaussians(made.means, made.quats, made.log_scales, logits, made.sh))
    model, found = read_model(path), info(path)
    assert isinstance(found, ModelInfo)
    assert (found.gaussians, found.sh_degree) == (500, degree) == (len(model), model.sh_degree)
    assert found.bytes == path.stat().st_size
    for corner, meant in zip(found.bounding_box, (model.means.amin(0), model.means.amax(0)), strict=True):
        assert corner == tuple(round(float(each), 4) for each in meant)
    assert found.nearly_transparent == round(float((model.opacities < 0.05).float().mean()), 4)
