"""The choice of a model format, and `info` on models."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from keyss import info
from keyss.core import Gaussians, InputError, OutputError, UsageError
from keyss.files import (
    FORMATS,
    check_model_output,
    is_model_path,
    keeps_low_bits,
    known_suffixes,
    read_model,
    write_model,
)
from keyss.runs import ModelInfo
from tiny_scenes import random_gaussians

SUFFIXES = [suffix for model_format in FORMATS for suffix in model_format.suffixes]


@pytest.mark.parametrize("name", ["a.ply", "b.PLY", "c.Ply"])
def test_suffixes_in_any_case(tmp_path: Path, name: str) -> None:
    assert is_model_path(name)
    assert keeps_low_bits(name)
    write_model(tmp_path / name, random_gaussians(9))
    assert (tmp_path / name).read_bytes().startswith(b"ply\n")


def test_suffix_of_another_format(tmp_path: Path) -> None:
    write_model(tmp_path / "a.spz", random_gaussians(5))
    path = (tmp_path / "a.spz").rename(tmp_path / "a.ply")
    with pytest.raises(
        InputError, match=r"a\.ply: the name says PLY, but the content is SPZ; .* end in \.spz"
    ):
        read_model(path)


@pytest.mark.parametrize("name", ["a.lcc", "a", "ply", "a.ply.txt"])
def test_unknown_suffixes(tmp_path: Path, name: str) -> None:
    assert not is_model_path(name)
    for write in (lambda path: write_model(path, random_gaussians(5)), lambda p: check_model_output(p, True)):
        with pytest.raises(UsageError, match=rf"{name}: expected .* ends in {re.escape(known_suffixes())}$"):
            write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_round_trips(tmp_path: Path, suffix: str) -> None:
    model = random_gaussians(40, sh_degree=1)
    path = tmp_path / f"a{suffix}"
    write_model(path, model)
    assert is_model_path(path)
    assert len(read_model(path)) == 40
    if keeps_low_bits(path):
        assert read_model(path).digest() == model.digest()
    model_format = next(entry for entry in FORMATS if suffix in entry.suffixes)
    if model_format.magic or model_format.archive:
        assert read_model(path).digest() == read_model(path.rename(tmp_path / "download")).digest()


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix != ".ply"])
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
