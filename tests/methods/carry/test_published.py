"""Carrying in .spz, .sog and compressed .ply files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import keyss
from channels.lsb.quantised import model_of
from files.formats.examples import same_codes
from keyss import CarryOptions
from keyss.channels import SUFFIXES, channel_for, in_counted_order
from keyss.files import read_model, write_model

every_format = pytest.mark.parametrize("format", SUFFIXES)


@every_format
def test_hide_reveal_verify_and_info(format: str, tmp_path: Path) -> None:
    cover, secrets = model_of(4000), [model_of(100, seed) for seed in (1, 2)]
    options = CarryOptions(format=format)  # type: ignore[arg-type]
    asked = [keyss.Secret(model, f"key number {i}") for i, model in enumerate(secrets)]
    keyss.hide(cover, asked, method=options, views=keyss.ViewOptions(32), min_psnr=0, out=tmp_path / "run")
    (stego,) = (tmp_path / "run" / "publish").iterdir()
    assert stego.name == f"model{SUFFIXES[format]}"
    for index, secret in enumerate(secrets):
        revealed = keyss.reveal(stego, f"key number {index}").gaussians
        assert len(revealed) == 100
        # Packing sorts them.
        nearest = torch.cdist(revealed.means, secret.means).min(dim=1).values
        assert float(nearest.max()) < 0.01
        assert keyss.verify(stego, f"key number {index}").secrets
    with pytest.raises(keyss.WrongKeyError):
        keyss.reveal(stego, "another key")
    assert keyss.info(stego).kind == "3DGS model"
    assert keyss.info(tmp_path / "run").kind == "hiding"


@every_format
def test_large_secrets_are_pruned(format: str) -> None:
    cover, asked = model_of(2500), [keyss.Secret(model_of(1500, 1), "key one")]
    pruning = CarryOptions(format=format, fine_tune="never")  # type: ignore[arg-type]
    hidden = keyss.hide(cover, asked, method=pruning, views=keyss.ViewOptions(32), min_psnr=0)
    assert 250 < hidden.metrics.secret_gaussians[0] < 1000


@every_format
def test_quantised_cover_keeps_its_codes(format: str, tmp_path: Path) -> None:
    path = tmp_path / f"cover{SUFFIXES[format]}"
    write_model(path, model_of(3000))
    model = read_model(path)
    prepared = channel_for("unchanged", format=format).prepare(model)
    assert same_codes(prepared.codes, in_counted_order(model.codes)[1])  # type: ignore[attr-defined]
