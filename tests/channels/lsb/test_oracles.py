"""Other people's programs read what carries, and find the untouched file's values to within a few steps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from channels.lsb.quantised import FORMATS, model_of
from files.formats.examples import same_codes
from keyss.channels import SUFFIXES, Payload, channel_for
from keyss.core import Gaussians, WrongKeyError
from keyss.files import read_model, write_model
from keyss.methods import embed_models, registry

EVERY = pytest.mark.parametrize("name", SUFFIXES)
# How far two files may be apart: positions in sizes of the Gaussian (the middle one of its scales), half of
# what is written there, and in a .sog, whose steps are known to a factor of 1.5, as much more; log scales.
STEPS = {"spz": (1 / 16, 1e-6), "sog": (1.5 / 16, 1e-6), "compressed-ply": (1e-6, 1 / 32)}


def files(name: str, folder: Path) -> tuple[Path, Path]:
    """An untouched file, and one that carries something under the key "key"."""
    cover = channel_for("unchanged", format=name).prepare(model_of())  # type: ignore[arg-type]
    plain, stego = (folder / f"{which}{SUFFIXES[name]}" for which in ("plain", "stego"))
    write_model(plain, cover.cover)
    write_model(stego, cover.embed([("key", Payload("carry", b"data"))]))
    return plain, stego


def assert_near(name: str, plain: Gaussians, stego: Gaussians) -> None:
    if name == "sog":  # sorted anew: compare in the order of one coordinate that stays, then of the others
        assert len(plain) == len(stego)
        nearest = torch.cdist(stego.means, plain.means).argmin(dim=1)
        same = (plain.log_scales[nearest] - stego.log_scales).abs().amax(dim=1) < 1e-6
        assert same.float().mean() > 0.99
        plain, stego = plain[nearest[same]], stego[same]
    sizes = plain.log_scales.exp().median(dim=1, keepdim=True).values
    assert float(((plain.means - stego.means).abs() / sizes).max()) <= STEPS[name][0] * 1.01
    assert float((plain.log_scales - stego.log_scales).abs().max()) <= STEPS[name][1] * 1.01
    assert torch.equal(plain.opacity_logits, stego.opacity_logits)
    assert torch.equal(plain.sh, stego.sh)
    turned = (torch.nn.functional.normalize(plain.quats) * torch.nn.functional.normalize(stego.quats)).sum(1)
    assert float(turned.abs().min()) > 0.999


@EVERY
def test_gsply_reads_it(name: str, tmp_path: Path) -> None:
    plain, stego = files(name, tmp_path)
    read = {
        "spz": lambda path: gsply.read_spz(str(path)),
        "sog": lambda path: gsply.sogread(str(path)),
        "compressed-ply": lambda path: gsply.plyread(str(path)),
    }[name]
    untouched, carrying = (read(each) for each in (plain, stego))
    assert len(untouched.means) == len(carrying.means)
    assert np.isfinite(carrying.means).all()
    ours = read_model(stego)
    # It leaves an SPZ as it lies there, with y up.
    signs = np.array([1, -1, -1]) if name == "spz" else 1
    assert np.allclose(np.asarray(carrying.means) * signs, ours.means.numpy(), atol=1e-4)


@EVERY
def test_splat_transform_reads_it(splat_transform: Callable[..., Path], name: str, tmp_path: Path) -> None:
    both = [
        read_model(splat_transform(each, tmp_path / f"{index}.ply"))
        for index, each in enumerate(files(name, tmp_path))
    ]
    assert_near(name, *both)


@EVERY
def test_it_opens_from_the_very_file_and_from_no_other(name: str, tmp_path: Path) -> None:
    prepared, secret = channel_for("unchanged", format=name).prepare(model_of()), model_of(200, seed=3)  # type: ignore[arg-type]
    _, stego = files(name, tmp_path)
    made = embed_models(prepared, ["key"], [secret])
    write_model(stego, made.gaussians)
    again = read_model(stego)
    found = registry.open_model(again, "key").reveal(again)
    assert len(found) == 200
    assert torch.equal(found.means, made.opened[0].reveal(again).means)
    # A file that is written of the model as it is keeps what it carries; a changed model carries nothing.
    write_model(tmp_path / f"copy{SUFFIXES[name]}", again)
    assert (tmp_path / f"copy{SUFFIXES[name]}").read_bytes() == stego.read_bytes()
    with pytest.raises(WrongKeyError):
        registry.open_model(again[:-1], "key")
    codes = FORMATS[SUFFIXES[name]].parse(stego.read_bytes())
    assert same_codes(codes, made.gaussians.codes)  # type: ignore[attr-defined]
